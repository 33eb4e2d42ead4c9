"""Wakes what waits in the event loop when something happened on another thread."""

import asyncio


class Bell:
    """Ring from any thread; wait in the one event loop it was opened in."""

    def __init__(self) -> None:
        self._loop: asyncio.AbstractEventLoop | None = None
        self._next = asyncio.Event()
        self.closed = False

    def open(self) -> None:
        """Bind to the running event loop."""
        self._loop = asyncio.get_running_loop()

    def ring(self) -> None:
        """Wake everyone who waits now; harmless before `open` and after the loop's end."""
        if self._loop is not None and not self._loop.is_closed():
            self._loop.call_soon_threadsafe(self._wake)

    def close(self) -> None:
        """Wake everyone for good: `closed` tells them to end. May be called by a signal handler."""
        self.closed = True
        self.ring()

    def next_ring(self) -> asyncio.Event:
        """Return what the next ring sets. Take it before looking for news, so that none is missed.

        Must be called in the event loop.
        """
        return self._next

    def _wake(self) -> None:
        self._next.set()
        self._next = asyncio.Event()


async def wait_for_ring(ring: asyncio.Event, timeout_s: float) -> bool:
    """Return true when it rings, false after `timeout_s` of silence."""
    try:
        return await asyncio.wait_for(ring.wait(), timeout_s)
    except TimeoutError:
        return False
