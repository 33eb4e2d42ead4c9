"""Serve an app until a signal; the arm stands before the listener closes.

Open event streams do not hold the end up.
"""

import asyncio
import errno
import logging
import socket
from types import FrameType

import uvicorn
from fastapi import FastAPI

from canopy_skel.errors import UsageError
from service.app import end_motion, end_streams

_BACK_STOP_S = 1
_LOOK_S = 0.1
_log = logging.getLogger("uvicorn.error")  # the one that uvicorn sets up


class Server(uvicorn.Server):
    """Ends open streams as soon as a signal comes, and then returns to the caller.

    uvicorn waits for connections before the app's lifespan ends, so a lifespan is too late to end
    them; and it raises the signal again afterwards, which would skip the caller's own clean-up.
    """

    def __init__(self, app: FastAPI, config: uvicorn.Config) -> None:
        super().__init__(config)
        self._canopy = app

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """Begin to serve; say where, which uvicorn does only of sockets of its own."""
        await super().startup(sockets)
        for bound in sockets or []:
            host, port = bound.getsockname()[:2]
            address = f"[{host}]:{port}" if bound.family is socket.AF_INET6 else f"{host}:{port}"
            _log.info("Serving at http://%s (Press CTRL+C to quit)", address)

    def handle_exit(self, sig: int, frame: FrameType | None) -> None:
        """Begin to end; a second signal ends at once."""
        if self.should_exit:
            self.force_exit = True
        self.should_exit = True
        end_streams(self._canopy)

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        """End what moves while a stop is still answered; then the connections.

        A second signal waits for neither.
        """
        ending = asyncio.create_task(asyncio.to_thread(end_motion, self._canopy))
        while not (ending.done() or self.force_exit):
            await asyncio.wait([ending], timeout=_LOOK_S)
        await super().shutdown(sockets)


def make_server(app: FastAPI, *, port: int = 8000, log_level: str = "info") -> Server:
    """Return a server for the app, to be run with `run()`; one process, since there is one arm.

    port: of 127.0.0.1, unless `run` is given sockets.
    """
    config = uvicorn.Config(
        app,
        port=port,
        log_level=log_level,
        access_log=False,
        timeout_graceful_shutdown=_BACK_STOP_S,
        server_header=False,
    )
    return Server(app, config)


def listening(host: str, port: int) -> socket.socket:
    """Return a socket that listens, for `Server.run`: taken before a rig is started for it.

    Who calls before the server runs is answered as soon as it does. port: 0 = any free one.

    Raises:
        UsageError: the address is taken, or none of this machine's.
    """
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    try:
        return socket.create_server((host, port), family=family)
    except OSError as error:
        why = "it is taken" if error.errno == errno.EADDRINUSE else error.strerror
        raise UsageError(
            f"cannot listen at {host}, port {port}: {why}; end what listens there, or choose"
            " another --host or --port"
        ) from error
