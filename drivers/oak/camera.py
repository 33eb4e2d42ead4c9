"""An OAK-D as a Camera. depthai may block, abort or lose the device: that ends a child, not us."""

import logging
import math
import sys
import threading
import time
from collections.abc import Sequence
from dataclasses import replace
from types import TracebackType
from typing import Self

from drivers.errors import CameraTimeoutError, NoCameraError
from drivers.oak.messages import Grab, OakConfig, Picture
from drivers.oak.process import CameraProcess
from drivers.protocols import CameraImage

log = logging.getLogger(__name__)

_PAUSE_S = 0.3
_RETRY_S = 2.0
_NOT_OPEN = "the camera is not open: use it inside its `with` block"
_COMMAND = (sys.executable, "-m", "drivers.oak.child")


class OakCamera:
    """An OAK-D behind depthai; see `drivers.protocols.Camera`.

    A process that died or hangs is replaced while `grab` has time left; otherwise by the next
    `grab`. One thread grabs at a time, any thread may leave.

    Args:
        config: which device, and what it shall deliver.
        command: what runs as the child; the file descriptor of its pipe is appended.
    """

    def __init__(self, config: OakConfig | None = None, command: Sequence[str] = _COMMAND) -> None:
        self._config = config or OakConfig()
        self._command = command
        self._grabbing = threading.Lock()
        self._process: CameraProcess | None = None
        self._started_s = -math.inf
        self._why = NoCameraError("the camera is starting: wait for it")
        self._open = False
        self._number = 0
        self._newest_ns = 0

    def __enter__(self) -> Self:
        """Start the child and wait until the device delivers.

        Raises:
            NoCameraError: no device, no depthai, or it does not start; nothing is left open.
        """
        self._open = True
        process = self._start()
        until_s = time.perf_counter() + self._config.open_timeout_s
        try:
            while not process.ready:
                process.hear(until_s)
        except BaseException:
            self.__exit__(None, None, None)
            raise
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        """Close the device; a `grab` under way in another thread ends with NoCameraError."""
        self._open = False
        if not self._grabbing.acquire(blocking=False):
            process = self._process
            if process is not None:
                process.kill()
            self._grabbing.acquire()
        try:
            self._bury(kindly=True)
        finally:
            self._grabbing.release()

    @property
    def pid(self) -> int | None:
        """Return the process id of the present child."""
        return self._process.pid if self._process else None

    def check(self) -> None:
        """Raise NoCameraError if the device is gone; its process is started again by and by.

        While another thread grabs, that thread finds out.
        """
        if not self._open:
            raise NoCameraError(_NOT_OPEN)
        if self._grabbing.acquire(blocking=False):
            try:
                self._check()
            finally:
                self._grabbing.release()

    def _check(self) -> None:
        process = self._process
        if process is None:
            if time.perf_counter() - self._started_s < _RETRY_S:
                raise NoCameraError(str(self._why))
            process = self._start()
        try:
            while process.hear(time.perf_counter()) is not None:
                pass
        except NoCameraError as error:
            self._lose(error)
            raise
        if not process.ready:
            raise NoCameraError(str(self._why))
        if process.owes:
            raise NoCameraError("the last picture has not come yet: look at cable and light")

    def grab(self, timeout_s: float) -> CameraImage:
        """Return a picture no part of which was exposed before this call; see `Camera.grab`.

        Raises:
            CameraTimeoutError: the camera runs, but no picture came in time.
            NoCameraError: not open, or gone and not back in time; the next call tries again.
        """
        called_ns = time.monotonic_ns()
        until_s = time.perf_counter() + timeout_s
        if not self._grabbing.acquire(timeout=max(0.0, timeout_s)):
            raise CameraTimeoutError(f"another thread grabs; no picture within {timeout_s} s")
        try:
            return self._grab(max(called_ns, self._newest_ns), until_s, timeout_s)
        finally:
            self._grabbing.release()

    def _grab(self, not_before_ns: int, until_s: float, timeout_s: float) -> CameraImage:
        why: NoCameraError | None = None
        while self._open:
            try:
                image = self._ask(Grab(self._next(), not_before_ns), until_s)
            except NoCameraError as error:
                why = error
                self._lose(error)
                if time.perf_counter() + _PAUSE_S > until_s:
                    raise
                time.sleep(_PAUSE_S)
                continue
            if image is not None:
                self._newest_ns = image.stamp_ns
                return image
            raise why or CameraTimeoutError(
                f"no picture within {timeout_s} s; look at cable and light, or allow more time"
            )
        raise NoCameraError(_NOT_OPEN)

    def _ask(self, grab: Grab, until_s: float) -> CameraImage | None:
        """Return the picture, None if it does not come in time; start a child if there is none."""
        process, asked = self._process or self._start(), False
        while True:
            if process.ready and not asked:
                process.ask(grab)
                asked = True
            answer = process.hear(until_s)
            if answer is None:
                return None
            if isinstance(answer, Picture) and answer.number == grab.number:
                return replace(answer.image)  # unpickled arrays are writable until checked in

    def _next(self) -> int:
        self._number += 1
        return self._number

    def _start(self) -> CameraProcess:
        self._process = CameraProcess(self._config, self._command)
        self._started_s = time.perf_counter()
        return self._process

    def _lose(self, error: NoCameraError) -> None:
        log.warning("camera: %s", error)
        self._why = error
        self._bury(kindly=False)

    def _bury(self, *, kindly: bool) -> None:
        process, self._process = self._process, None
        if process is not None:
            process.close(kindly=kindly)
