"""Port 30004: the Real-Time Data Exchange protocol, versions 1 and 2.

Wire format: Universal Robots, "Real-Time Data Exchange (RTDE) Guide". Every package is a
big-endian uint16 size (header included), a type byte and a payload.
"""

import asyncio
import struct
from dataclasses import dataclass, field

from mock_hw.fake_ur.controller import Controller
from mock_hw.fake_ur.network import Network
from mock_hw.fake_ur.variables import (
    INPUT_TYPES,
    WIRE_FORMAT,
    Output,
    Value,
    Values,
    apply_inputs,
    find_output,
)

PORT = 30004
_HEADER = struct.Struct(">HB")
_PROTOCOL, _VERSION = ord("V"), ord("v")
_OUTPUTS, _INPUTS = ord("O"), ord("I")
_START, _PAUSE, _DATA = ord("S"), ord("P"), ord("U")
_BACKLOG_BYTES = 16384


@dataclass(frozen=True, kw_only=True, eq=False, slots=True)
class InputRecipe:
    """Names of one kind of package a client sends, in the order of the bytes."""

    names: tuple[str, ...]
    counts: tuple[int, ...]
    layout: struct.Struct

    def unpack(self, payload: bytes) -> dict[str, Values]:
        """Return the values by name; bytes beyond the recipe are ignored."""
        values = self.layout.unpack_from(payload)
        found: dict[str, Values] = {}
        start = 0
        for name, count in zip(self.names, self.counts, strict=True):
            found[name] = values[start : start + count]
            start += count
        return found


@dataclass(eq=False, slots=True)
class Client:
    """One connection: its protocol version, recipes and whether it has started."""

    writer: asyncio.StreamWriter
    version: int = 1
    outputs: list[Output] = field(default_factory=list)
    output_layout: struct.Struct = field(default_factory=lambda: struct.Struct(">"))
    output_period_s: float = 0.0
    next_due_s: float = 0.0
    inputs: dict[int, InputRecipe] = field(default_factory=dict)
    started: bool = False

    def send(self, kind: int, payload: bytes) -> None:
        """Send one package."""
        self.writer.write(_HEADER.pack(_HEADER.size + len(payload), kind) + payload)


class RtdeServer:
    """Answers RTDE clients and streams the outputs they asked for."""

    def __init__(self, controller: Controller, network: Network) -> None:
        self._controller = controller
        self._network = network
        self._clients: list[Client] = []

    async def serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Talk to one client until it goes away."""
        client = Client(writer=writer)
        self._clients.append(client)
        try:
            while True:
                size, kind = _HEADER.unpack(await reader.readexactly(_HEADER.size))
                payload = await reader.readexactly(size - _HEADER.size)
                await self._network.answering()
                self._answer(client, kind, payload)
        finally:
            self._clients.remove(client)

    def shortest_period_s(self) -> float:
        """Return how often a client wants outputs; as often as possible while none has started."""
        periods_s = (client.output_period_s for client in self._clients if client.started)
        return min(periods_s, default=self._controller.period_s)

    def stream(self) -> None:
        """Send the outputs of this control cycle to every client whose turn it is."""
        now_s = self._controller.stamp_s
        for client in self._clients:
            if not client.started or now_s + 1e-9 < client.next_due_s:
                continue
            period_s = max(client.output_period_s, self._network.slow_period_s)
            client.next_due_s += period_s
            if client.next_due_s <= now_s:
                client.next_due_s = now_s + period_s
            if client.writer.transport.get_write_buffer_size() < _BACKLOG_BYTES:
                client.send(_DATA, self._data(client))

    def _data(self, client: Client) -> bytes:
        values: list[Value] = [1] if client.version == 2 else []
        for output in client.outputs:
            values.extend(output.read(self._controller))
        return client.output_layout.pack(*values)

    def _answer(self, client: Client, kind: int, payload: bytes) -> None:
        if kind == _PROTOCOL:
            (wanted,) = struct.unpack(">H", payload)
            accepted = wanted in (1, 2)
            client.version = wanted if accepted else client.version
            client.send(kind, struct.pack(">B", accepted))
        elif kind == _VERSION:
            client.send(kind, struct.pack(">4I", *self._controller.version))
        elif kind == _OUTPUTS:
            client.send(kind, self._set_outputs(client, payload))
        elif kind == _INPUTS:
            client.send(kind, self._add_inputs(client, payload))
        elif kind in (_START, _PAUSE):
            client.started = kind == _START and bool(client.outputs)
            client.send(kind, struct.pack(">B", client.started if kind == _START else True))
        elif kind == _DATA:
            recipe = client.inputs.get(payload[0])
            if recipe is not None:
                apply_inputs(self._controller, recipe.unpack(payload[1:]))

    def _set_outputs(self, client: Client, payload: bytes) -> bytes:
        frequency_hz = 125.0
        if client.version == 2:
            (frequency_hz,) = struct.unpack_from(">d", payload)
            payload = payload[8:]
        names = _names(payload)
        found = [find_output(name, self._controller.version[0]) for name in names]
        types = ",".join(output.type if output else "NOT_FOUND" for output in found)
        client.outputs = [output for output in found if output] if all(found) else []
        head = ">B" if client.version == 2 else ">"
        fields = "".join(WIRE_FORMAT[output.type] for output in client.outputs)
        client.output_layout = struct.Struct(head + fields)
        fastest_hz = 1 / self._controller.period_s
        client.output_period_s = 1 / min(max(frequency_hz, 1.0), fastest_hz)
        recipe_id = b"\x01" if client.version == 2 else b""
        return recipe_id + types.encode()

    def _add_inputs(self, client: Client, payload: bytes) -> bytes:
        names = _names(payload)
        taken = {
            name
            for other in self._clients
            if other is not client
            for recipe in other.inputs.values()
            for name in recipe.names
        }
        types = [
            "IN_USE" if name in taken else INPUT_TYPES.get(name, "NOT_FOUND") for name in names
        ]
        if "IN_USE" in types or "NOT_FOUND" in types:
            return b"\x00" + ",".join(types).encode()
        recipe_id = len(client.inputs) + 1
        formats = [WIRE_FORMAT[kind] for kind in types]
        client.inputs[recipe_id] = InputRecipe(
            names=tuple(names),
            counts=tuple(int(wire[:-1] or 1) for wire in formats),
            layout=struct.Struct(">" + "".join(formats)),
        )
        return bytes([recipe_id]) + ",".join(types).encode()


def _names(payload: bytes) -> list[str]:
    return [name for name in payload.decode().split(",") if name]
