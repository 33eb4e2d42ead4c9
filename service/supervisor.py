"""Keep a child process running: started again when it ends, ended when we do."""

import logging
import subprocess
import threading
from collections.abc import Sequence
from types import TracebackType
from typing import Self

log = logging.getLogger(__name__)

FIRST_PAUSE_S = 0.5
LONGEST_PAUSE_S = 10.0
STOP_TIMEOUT_S = 1.5


class Supervised:
    """A command that is started again whenever it ends, after a pause that grows."""

    def __init__(self, name: str, command: Sequence[str]) -> None:
        self._name = name
        self._command = list(command)
        self._ending = threading.Event()
        self._process: subprocess.Popen[bytes] | None = None
        self._lock = threading.Lock()
        self._thread = threading.Thread(target=self._watch, name=f"supervise-{name}", daemon=True)

    def __enter__(self) -> Self:
        """Start it."""
        self._launch()
        self._thread.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        """End it, politely first."""
        with self._lock:
            self._ending.set()
            process = self._process
        if process is not None:
            process.terminate()
            try:
                process.wait(STOP_TIMEOUT_S)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
        self._thread.join()

    @property
    def pid(self) -> int | None:
        """The process as it is now, None between two lives."""
        process = self._process
        return process.pid if process is not None and process.poll() is None else None

    def _launch(self) -> None:
        with self._lock:
            if not self._ending.is_set():
                # A session of its own: Ctrl-C is for us, and we end our children in order.
                self._process = subprocess.Popen(self._command, start_new_session=True)

    def _watch(self) -> None:
        pause_s = FIRST_PAUSE_S
        while not self._ending.is_set():
            process = self._process
            code = process.wait() if process is not None else 0
            if self._ending.wait(pause_s):
                return
            log.warning("%s ended with %s; starting it again", self._name, code)
            pause_s = min(2 * pause_s, LONGEST_PAUSE_S)
            self._launch()
