"""The parent's side of the arm's child process: starts it, listens to it, replaces it."""

import sys
import threading
from collections.abc import Callable

from drivers import errors
from drivers.child import Child
from drivers.errors import ArmLinkError, DriverProcessError, NotConnectedError
from drivers.ur5.messages import (
    Answer,
    Command,
    Farewell,
    Leave,
    Reply,
    Request,
    Sample,
    Ur5Config,
)

_COMMAND = (sys.executable, "-m", "drivers.ur5.child")
_SILENCE_S = 1.0
_LEAVE_S = 2.0
_BACKOFF_S = (0.05, 0.2, 0.5, 1.0)


class Pending:
    """A command on its way; wait for its reply. Not `sent` where there was no child for it."""

    def __init__(self, number: int, sent: bool) -> None:
        self.number = number
        self.sent = sent
        self._answered = threading.Event()
        self._reply: Reply | None = None

    def settle(self, reply: Reply | None) -> None:
        """Give the reply, or None where there will be none."""
        self._reply = reply
        self._answered.set()

    def wait(self, timeout_s: float) -> Reply | None:
        """Return the reply, or None where it does not come."""
        return self._reply if self._answered.wait(timeout_s) else None


class ChildLink:
    """A child process that is always there, or being replaced."""

    def __init__(
        self,
        config: Ur5Config,
        on_sample: Callable[[Sample], None],
        on_down: Callable[[ArmLinkError], None],
    ) -> None:
        self._config = config
        self._on_sample = on_sample
        self._on_down = on_down
        self._lock = threading.Lock()
        self._changed = threading.Condition(self._lock)
        self._child: Child | None = None
        self._pending: dict[int, Pending] = {}
        self._number = 0
        self._up = False
        self._down: ArmLinkError | None = None
        self._why_killed = ""
        self._closing = threading.Event()
        self._supervisor = threading.Thread(target=self._supervise, name="ur5-link", daemon=True)

    def open(self) -> None:
        """Start the child and wait for its first package.

        Raises:
            ArmLinkError: there is no arm to talk to; nothing is left open.
        """
        self._supervisor.start()
        with self._changed:
            self._changed.wait_for(lambda: self._up or self._down, self._config.connect_timeout_s)
            up, down = self._up, self._down
        if not up:
            self.close()
            raise down or DriverProcessError(
                f"the arm's driver process did not connect to {self._config.host} in time"
            )

    def close(self) -> None:
        """End the child; the arm's program is ended first where the child still answers."""
        if self._closing.is_set():
            return
        self._closing.set()
        if self.up:
            self.post(Leave()).wait(self._config.command_timeout_s)
        self.kill()
        self._supervisor.join()

    @property
    def up(self) -> bool:
        """Say whether a child is connected to the controller."""
        return self._up

    @property
    def pid(self) -> int | None:
        """Return the process id of the present child."""
        return self._child.pid if self._child else None

    def why_down(self) -> ArmLinkError:
        """Return why there is no connection."""
        return self._down or NotConnectedError(f"not connected to {self._config.host}")

    def post(self, request: Request) -> Pending:
        """Send a request; where there is no child its reply never comes."""
        with self._lock:
            self._number += 1
            child = self._child if self._up else None
            pending = Pending(self._number, sent=child is not None)
            if child is None:
                pending.settle(None)
                return pending
            self._pending[self._number] = pending
            child.send(Command(self._number, request))
        return pending

    def kill(self, why: str = "") -> None:
        """End the present child without asking it; another is started unless closing."""
        child = self._child
        if child is not None:
            self._why_killed = why
            child.kill()

    def _supervise(self) -> None:
        failures = 0
        while not self._closing.is_set():
            child = self._spawn()
            down = self._listen(child)
            failures = 0 if self._up else failures + 1
            self._bury(child, down)
            if not self._closing.is_set():
                self._on_down(down)
                self._closing.wait(_BACKOFF_S[min(failures, len(_BACKOFF_S) - 1)])

    def _spawn(self) -> Child:
        child = self._child = Child(_COMMAND)
        self._why_killed = ""
        if self._closing.is_set():
            child.kill()
        child.send(self._config)
        return child

    def _listen(self, child: Child) -> ArmLinkError:
        """Take what the child says until it ends or falls silent; return why."""
        patience_s = self._config.connect_timeout_s
        while True:
            try:
                if not child.pipe.poll(patience_s):
                    return DriverProcessError("the arm's driver process hung and was ended")
                answer: Answer = child.pipe.recv()
            except (EOFError, OSError):
                code = child.exit_code(_LEAVE_S)
                why = self._why_killed or f"died (exit code {code})"
                return DriverProcessError(f"the arm's driver process {why}")
            if isinstance(answer, Farewell):
                cause: type[ArmLinkError] = getattr(errors, answer.error)
                return cause(answer.text)
            patience_s = _SILENCE_S
            self._take(answer)

    def _take(self, answer: Answer) -> None:
        if isinstance(answer, Sample):
            self._on_sample(answer)
            if not self._up:
                with self._changed:
                    self._up, self._down = True, None
                    self._changed.notify_all()
        elif isinstance(answer, Reply):
            with self._lock:
                pending = self._pending.pop(answer.number, None)
            if pending is not None:
                pending.settle(answer)

    def _bury(self, child: Child, down: ArmLinkError) -> None:
        child.kill()
        with self._changed:
            self._up, self._down = False, down
            orphans = list(self._pending.values())
            self._pending.clear()
            self._changed.notify_all()
        child.end(_LEAVE_S)
        for pending in orphans:
            pending.settle(None)
