"""Start a fake controller in a process of its own, and do things to it through its fault port."""

import json
import random
import socket
import sys
from types import TracebackType
from typing import Any, Self

from drivers.child import Child
from mock_hw.fake_ur import dashboard

_LEAVE_S = 5.0


def free_host() -> str:
    """Return a loopback address on which no controller listens yet."""
    for number in random.sample(range(2, 255), 253):
        host = f"127.0.0.{number}"
        with socket.socket() as probe:
            try:
                probe.bind((host, dashboard.PORT))
            except OSError:
                continue
        return host
    raise RuntimeError("every loopback address 127.0.0.N has a controller already; end some")


class FakeUr:
    """A running fake controller; a context manager that ends it."""

    def __init__(self, host: str, *, version: str = "3.15", time_scale: float = 1.0) -> None:
        self.host = host
        self._command = [sys.executable, "-m", "mock_hw.fake_ur", "--host", host]
        self._command += ["--version", version, "--time-scale", str(time_scale), "--parent"]
        self._child: Child | None = None
        self._fault_port = 0

    def __enter__(self) -> Self:
        """Start the process and wait for its ready line.

        Raises:
            RuntimeError: it ended instead, for example because the address is taken.
        """
        self._child = Child(self._command, captured=True)
        line = self._child.output.readline().decode()
        if not line.startswith("ready"):
            self.close()
            raise RuntimeError(f"the fake controller did not start on {self.host}: {line!r}")
        self._fault_port = int(line.split("fault_port=")[1])
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        """End the process."""
        self.close()

    def do(self, action: str, **arguments: float) -> dict[str, Any]:
        """Ask the fault port for an action and return the state of the arm after it.

        Raises:
            RuntimeError: there is no such action, or the controller refuses it.
        """
        with socket.create_connection((self.host, self._fault_port), timeout=5.0) as link:
            link.sendall(json.dumps({"do": action, **arguments}).encode() + b"\n")
            with link.makefile() as answers:
                answer = json.loads(answers.readline())
        if not answer["ok"]:
            raise RuntimeError(answer["error"])
        state: dict[str, Any] = answer["state"]
        return state

    def kill(self) -> None:
        """End the process without warning, as a power cut would; entering starts another."""
        if self._child is not None:
            self._child.kill()
            self.close()

    def close(self) -> None:
        """End the process; does nothing when it has ended already."""
        child, self._child = self._child, None
        if child is not None:
            child.end(_LEAVE_S)
