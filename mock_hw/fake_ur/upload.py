"""Ports 30001 to 30003: URScript text in; a program replaces the one that runs."""

import asyncio
import re

from mock_hw.fake_ur.controller import Controller, RefusedError, log
from mock_hw.fake_ur.network import Network
from mock_hw.fake_ur.script import load

PORTS = (30001, 30002, 30003)
_PROGRAM_END = re.compile(rb"^end[ \t]*\r?\n", re.M)
_LARGEST_PROGRAM_BYTES = 1 << 20


class ScriptServer:
    """Collects programs and starts them."""

    def __init__(self, controller: Controller, network: Network) -> None:
        self._controller = controller
        self._network = network

    async def serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Take programs from one client until it goes away."""
        received = b""
        while chunk := await reader.read(65536):
            await self._network.answering()
            received += chunk
            while end := _PROGRAM_END.search(received):
                self._start(received[: end.end()].decode(errors="replace"))
                received = received[end.end() :]
            if len(received) > _LARGEST_PROGRAM_BYTES:
                return

    def _start(self, text: str) -> None:
        try:
            self._controller.start_program(load(text, self._controller))
        except RefusedError as refused:
            log.warning("program refused: %s", refused)
