"""The process that owns ur-rtde: `python -m drivers.ur5.child FD`, FD being one end of a pipe.

ur-rtde can hold the interpreter for seconds (constructors), reconnect and repeat a command after
a lost link, and abort the process when a controller goes away. So it lives here, alone, and this
process never tries to save itself: when the link is lost it ends at once, without destructors,
and the parent starts another.

Two threads: the main thread owns the control interface and does what the parent asks; the watch
thread owns the receive interface, sends every package to the parent and ends the process.
"""

import os
import socket
import struct
import sys
import threading
from multiprocessing.connection import Connection
from typing import TYPE_CHECKING, NoReturn

from drivers.ur5.claim import claim_upper_half
from drivers.ur5.messages import Leave, Reply, Ur5Config
from drivers.ur5.mover import Mover
from drivers.ur5.watch import VARIABLES, MoveRecord, Parent, Watch

if TYPE_CHECKING:
    from rtde_control import RTDEControlInterface
    from rtde_receive import RTDEReceiveInterface

_FREQUENCY_HZ = 125.0
_UPKEEP_S = 0.01
_IN_USE = "already in use"
"""What ur-rtde says, and nothing else of what it says, when another client has the registers."""
_TAKEN = (
    "the controller at {} is taken: its input registers are held by another program (a second"
    " service, another RTDE client, or EtherNet/IP, PROFINET or MODBUS in its installation) or by a"
    " lost connection for a moment yet; end that one, and this one then connects by itself"
)


def probe(host: str, timeout_s: float = 1.0) -> tuple[str, str] | None:
    """Ask for signs of life with a deadline, which the vendor library does not have.

    Returns:
        None, or the name of the error and what is wrong.
    """
    try:
        for port in (29999, 30003, 30004):
            with socket.create_connection((host, port), timeout_s) as link:
                link.settimeout(timeout_s)
                if port == 30004:
                    link.sendall(struct.pack(">HBH", 5, ord("V"), 2))
                if port != 30003 and not link.recv(1):
                    return ("LinkLostError", f"{host} closed port {port}")
    except TimeoutError:
        return ("ControllerFrozenError", f"{host} does not answer on port {port}: see the pendant")
    except OSError as error:
        where = f"{host}, port {port} ({error.strerror})"
        return ("NotConnectedError", f"no UR controller at {where}: check address, cable and power")
    return None


def main(pipe: Connection) -> NoReturn:
    """Serve the parent until it goes away."""
    config: Ur5Config = pipe.recv()
    parent, record = Parent(pipe), MoveRecord()
    problem = probe(config.host)
    if problem:
        parent.end(*problem)
    try:
        claim = claim_upper_half(config.host)
        if claim is None:
            parent.end("ArmTakenError", _TAKEN.format(config.host))
        receive, control = _connect(config.host)
    except ImportError as error:
        parent.end("NotConnectedError", f"{error}: install ur-rtde (wheels: Python 3.11, 3.12)")
    except RuntimeError as error:
        if _IN_USE in str(error):
            parent.end("ArmTakenError", _TAKEN.format(config.host))
        parent.end("NotConnectedError", f"{config.host}: {error}")
    except OSError as error:
        parent.end("LinkLostError", f"{config.host}: {error}")
    try:
        watch = Watch(receive, parent, record)
        threading.Thread(target=watch.run, daemon=True).start()
        mover = Mover(control, config, watch, record)
        _serve(parent, mover)
    except (OSError, RuntimeError) as error:
        parent.end("LinkLostError", f"{config.host}: {error}")
    os._exit(0)


def _connect(host: str) -> "tuple[RTDEReceiveInterface, RTDEControlInterface]":
    """Return receive and control interface; nothing is uploaded and no program is touched.

    Both constructors hold the interpreter. Whether the robot is in remote control is asked
    elsewhere: the vendor's check would keep us from reading the state of one that is not.
    """
    from rtde_control import RTDEControlInterface
    from rtde_receive import RTDEReceiveInterface

    receive = RTDEReceiveInterface(host, _FREQUENCY_HZ, VARIABLES)
    flags = RTDEControlInterface.FLAG_NO_WAIT
    flags |= RTDEControlInterface.FLAG_DISABLE_REMOTE_CONTROL_CHECK
    return receive, RTDEControlInterface(host, _FREQUENCY_HZ, flags)


def _serve(parent: Parent, mover: Mover) -> None:
    while True:
        try:
            command = parent.receive(_UPKEEP_S)
        except EOFError:
            mover.leave()
            return
        if command is not None:
            if isinstance(command.request, Leave):
                mover.leave()
                parent.send(Reply(command.number))
                return
            parent.send(Reply(command.number, mover.do(command.number, command.request)))
        mover.upkeep()


if __name__ == "__main__":
    main(Connection(int(sys.argv[1])))
