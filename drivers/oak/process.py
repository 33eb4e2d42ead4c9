"""The parent's side of one camera process: start it, hear it with a deadline, end it."""

import os
import subprocess
import sys
import threading
import time
from collections.abc import Sequence
from multiprocessing import Pipe

from drivers.errors import NoCameraError
from drivers.oak.messages import Answer, Farewell, Grab, OakConfig, Picture, Ready

_LEAVE_S = 2.0


class CameraProcess:
    """A child that is running until `close`, or until it is found dead or hanging.

    The child speaks only while it opens the device and while it owes a picture, so nothing has to
    be read in between; whether it lives is found out when it is asked.
    """

    def __init__(self, config: OakConfig, command: Sequence[str]) -> None:
        self.ready = False
        self._config = config
        self._owes = False
        self._heard_s = time.perf_counter()
        self._pipe, theirs = Pipe()
        environment = os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
        with theirs:
            self._process = subprocess.Popen(
                [*command, str(theirs.fileno())],
                pass_fds=[theirs.fileno()],
                stdin=subprocess.DEVNULL,
                env=environment,
            )
        self._send(config)

    @property
    def pid(self) -> int:
        """Return the process id."""
        return self._process.pid

    def ask(self, grab: Grab) -> None:
        """Ask for a picture; a picture still owed is forgotten by the child."""
        if not self._owes:
            self._owes, self._heard_s = True, time.perf_counter()
        self._send(grab)

    def hear(self, until_s: float) -> Answer | None:
        """Return what the child says next, None if nothing before `until_s` (perf_counter).

        Raises:
            NoCameraError: the child has ended or hangs; it must be closed.
        """
        patience_s = self._config.silence_s if self.ready else self._config.open_timeout_s
        silent_s = self._heard_s + patience_s
        try:
            if not self._pipe.poll(max(0.0, min(until_s, silent_s) - time.perf_counter())):
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
        self._owes = self._owes and not isinstance(answer, Picture)
        return answer

    def kill(self) -> None:
        """End the child at once."""
        self._process.kill()

    def close(self, *, kindly: bool) -> None:
        """End the child and the pipe; `kindly` lets it close the device first."""
        self._pipe.close()
        try:
            self._process.wait(_LEAVE_S if kindly else 0.0)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()

    def _send(self, message: OakConfig | Grab) -> None:
        try:
            self._pipe.send(message)
        except OSError:
            return  # the child is gone; what it said last is still to be heard

    def _receive(self, patience_s: float) -> Answer:
        """Read one message; a child that stops in the middle of one is ended."""
        guard = threading.Timer(patience_s, self._process.kill)
        guard.start()
        try:
            answer: Answer = self._pipe.recv()
        finally:
            guard.cancel()
        return answer

    def _obituary(self) -> str:
        try:
            code = self._process.wait(_LEAVE_S)
        except subprocess.TimeoutExpired:
            return "the camera's process closed its pipe"
        return f"the camera's process died (exit code {code})"
