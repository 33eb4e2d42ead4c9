"""The parent's side of one camera process: start it, hear it with a deadline, end it."""

import math
import threading
import time
from collections.abc import Sequence

from drivers.child import Child
from drivers.errors import NoCameraError
from drivers.oak.messages import Answer, Farewell, Grab, OakConfig, Picture, Ready

_LEAVE_S = 2.0


class CameraProcess:
    """A child that is running until `close`, or until it is found dead or hanging.

    The child speaks only while it opens the device and while it owes a picture, so nothing has to
    be read in between; but it may say that it ends. ready: the device runs. owes: a picture
    was asked for and has not come yet.
    """

    def __init__(self, config: OakConfig, command: Sequence[str]) -> None:
        self.ready = False
        self._config = config
        self.owes = False
        self._heard_s = time.perf_counter()
        self._child = Child(command)
        self._child.send(config)

    @property
    def pid(self) -> int:
        """Return the process id."""
        return self._child.pid

    def ask(self, grab: Grab) -> None:
        """Ask for a picture; a picture still owed is forgotten by the child."""
        if not self.owes:
            self.owes, self._heard_s = True, time.perf_counter()
        self._child.send(grab)

    def hear(self, until_s: float) -> Answer | None:
        """Return what the child says next, None if nothing before `until_s` (perf_counter).

        Raises:
            NoCameraError: the child has ended or hangs; it must be closed.
        """
        patience_s = self._config.silence_s if self.ready else self._config.open_timeout_s
        silent_s = self._heard_s + patience_s if self.owes or not self.ready else math.inf
        try:
            if not self._child.pipe.poll(max(0.0, min(until_s, silent_s) - time.perf_counter())):
                if time.perf_counter() < silent_s:
                    return None
                raise NoCameraError(f"the camera's process was silent for {patience_s} s: it hangs")
            answer = self._receive(patience_s)
        except (EOFError, OSError) as error:
            raise NoCameraError(self._obituary()) from error
        if isinstance(answer, Farewell):
            raise NoCameraError(answer.text)
        self._heard_s = time.perf_counter()
        self.ready = self.ready or isinstance(answer, Ready)
        self.owes = self.owes and not isinstance(answer, Picture)
        return answer

    def kill(self) -> None:
        """End the child at once."""
        self._child.kill()

    def close(self, *, kindly: bool) -> None:
        """End the child and the pipe; `kindly` lets it close the device first."""
        self._child.end(_LEAVE_S if kindly else 0.0)

    def _receive(self, patience_s: float) -> Answer:
        """Read one message; a child that stops in the middle of one is ended."""
        guard = threading.Timer(patience_s, self._child.kill)
        guard.start()
        try:
            answer: Answer = self._child.pipe.recv()
        finally:
            guard.cancel()
        return answer

    def _obituary(self) -> str:
        code = self._child.exit_code(_LEAVE_S)
        if code is None:
            return "the camera's process closed its pipe"
        return f"the camera's process died (exit code {code})"
