"""Serve an app until a signal; open event streams do not hold the end up."""

from types import FrameType

import uvicorn
from fastapi import FastAPI

from service.app import end_streams

_BACK_STOP_S = 1


class Server(uvicorn.Server):
    """Ends open streams as soon as a signal comes, and then returns to the caller.

    uvicorn waits for connections before the app's lifespan ends, so a lifespan is too late to end
    them; and it raises the signal again afterwards, which would skip the caller's own clean-up.
    """

    def __init__(self, app: FastAPI, config: uvicorn.Config) -> None:
        super().__init__(config)
        self._canopy = app

    def handle_exit(self, sig: int, frame: FrameType | None) -> None:
        """Begin to end; a second signal ends at once."""
        if self.should_exit:
            self.force_exit = True
        self.should_exit = True
        end_streams(self._canopy)


def make_server(
    app: FastAPI, *, host: str = "127.0.0.1", port: int = 8000, log_level: str = "info"
) -> Server:
    """Return a server for the app, to be run with `run()`; one process, since there is one arm."""
    config = uvicorn.Config(
        app,
        host=host,
        port=port,
        log_level=log_level,
        access_log=False,
        timeout_graceful_shutdown=_BACK_STOP_S,
        server_header=False,
    )
    return Server(app, config)
