"""A device of the rig, opened as soon as it is there."""

import threading
import time
from types import TracebackType
from typing import Self

from drivers.errors import DriverError
from drivers.protocols import Arm, Camera

RETRY_S = 2.0
"""Looking for a device that is not there costs a process each time."""


class Opened:
    """Opens an arm or a camera when it is first asked for, and again until it is there.

    A context manager; leaving closes the device.
    """

    def __init__(self, device: Arm | Camera) -> None:
        self._device = device
        self._opening = threading.Lock()
        self._is_open = False
        self._failure: DriverError | None = None
        self._retry_s = 0.0

    def __enter__(self) -> Self:
        """Do nothing yet: a device that is not there must not keep the rig from starting."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        """Close the device if it is open."""
        with self._opening:
            if self._is_open:
                self._is_open = False
                self._device.__exit__(kind, error, traceback)

    def open(self) -> None:
        """Open the device unless it is open.

        Raises:
            DriverError: it is not there, or another thread is opening it.
        """
        if not self._opening.acquire(blocking=False):
            raise DriverError("is being opened; ask again in a moment")
        try:
            self._open()
        finally:
            self._opening.release()

    def check(self) -> None:
        """Raise why the device cannot be used now; open it first if need be."""
        self.open()
        self._device.check()

    def _open(self) -> None:
        if self._is_open:
            return
        if self._failure is not None and time.monotonic() < self._retry_s:
            raise type(self._failure)(str(self._failure))
        try:
            self._device.__enter__()
        except DriverError as error:
            self._failure, self._retry_s = error, time.monotonic() + RETRY_S
            raise
        self._is_open = True
