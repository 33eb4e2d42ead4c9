"""The input register that keeps other clients of ur-rtde away while this one has the arm.

A controller gives each RTDE input to one connection at a time, until that is closed. The vendor's
client takes the lower half of the registers, or the upper half where it is told to; who has one
half could have its program replaced by who takes the other. So the arm is whose both are.

Wire format: Universal Robots, "Real-Time Data Exchange (RTDE) Guide".
"""

import socket
import struct

_PORT = 30004
_HEADER = struct.Struct(">HB")
_PROTOCOL, _INPUTS = ord("V"), ord("I")
_UPPER_COMMAND = b"input_int_register_24"
"""Where ur-rtde writes its commands when it uses the upper half."""


def claim_upper_half(host: str, timeout_s: float = 1.0) -> socket.socket | None:
    """Keep others from the upper half of the registers as long as the returned socket is open.

    Returns:
        None where another client has it.

    Raises:
        OSError: the controller does not answer, or not in time.
    """
    link = socket.create_connection((host, _PORT), timeout_s)
    try:
        _ask(link, _PROTOCOL, struct.pack(">H", 2))
        taken = b"IN_USE" in _ask(link, _INPUTS, _UPPER_COMMAND)
    except OSError:
        link.close()
        raise
    if taken:
        link.close()
        return None
    return link


def _ask(link: socket.socket, kind: int, payload: bytes) -> bytes:
    link.sendall(_HEADER.pack(_HEADER.size + len(payload), kind) + payload)
    while True:
        size, answered = _HEADER.unpack(_exactly(link, _HEADER.size))
        answer = _exactly(link, size - _HEADER.size)
        if answered == kind:
            return answer


def _exactly(link: socket.socket, count: int) -> bytes:
    received = b""
    while len(received) < count:
        chunk = link.recv(count - len(received))
        if not chunk:
            raise ConnectionError("the controller closed the connection")
        received += chunk
    return received
