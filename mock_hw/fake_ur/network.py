"""The wire between controller and clients, and what can happen to it."""

import asyncio
from collections.abc import Awaitable, Callable

Serve = Callable[[asyncio.StreamReader, asyncio.StreamWriter], Awaitable[None]]


class Network:
    """Listening ports whose traffic can be frozen, cut or slowed."""

    def __init__(self, host: str) -> None:
        self.slow_period_s = 0.0
        self._host = host
        self._servers: list[asyncio.Server] = []
        self._writers: set[asyncio.StreamWriter] = set()
        self._thawed = asyncio.Event()
        self._thawed.set()
        self._cut = False

    @property
    def frozen(self) -> bool:
        """Say whether nothing is answered while connections stay open."""
        return not self._thawed.is_set()

    async def listen(self, port: int, serve: Serve) -> int:
        """Serve a port (0: any free one) and return it.

        Connections end quietly when either side goes away.
        """

        async def connected(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
            if self._cut:
                writer.transport.abort()
                return
            self._writers.add(writer)
            try:
                await serve(reader, writer)
            except (ConnectionError, asyncio.IncompleteReadError):
                pass
            finally:
                self._writers.discard(writer)
                writer.close()

        server = await asyncio.start_server(connected, self._host, port)
        self._servers.append(server)
        return int(server.sockets[0].getsockname()[1])

    async def answering(self) -> None:
        """Wait while frozen."""
        await self._thawed.wait()

    def freeze(self) -> None:
        """Answer nothing from now on; connections stay open and new ones are accepted."""
        self._thawed.clear()

    def thaw(self) -> None:
        """Answer again, beginning with whatever was asked in the meantime."""
        self._thawed.set()

    def cut(self) -> None:
        """Reset every connection and every new one until `mend`."""
        self._cut = True
        for writer in self._writers:
            writer.transport.abort()

    def mend(self) -> None:
        """Undo `freeze`, `cut` and slow packages."""
        self._cut = False
        self.slow_period_s = 0.0
        self._thawed.set()

    async def close(self) -> None:
        """Stop listening, drop all connections and wait until nobody serves them any more."""
        self.mend()
        for server in self._servers:
            server.close()
        for writer in self._writers:
            writer.transport.abort()
        while self._writers:
            await asyncio.sleep(0.001)
