"""Start a fake controller in a process of its own, and do things to it through its fault port."""

import json
import os
import random
import signal
import socket
import subprocess
import sys
from types import TracebackType
from typing import Any, Self

from mock_hw.fake_ur import dashboard


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
        self._command += ["--version", version, "--time-scale", str(time_scale)]
        self._process: subprocess.Popen[str] | None = None
        self._fault_port = 0

    def __enter__(self) -> Self:
        """Start the process and wait for its ready line.

        Raises:
            RuntimeError: it ended instead, for example because the address is taken.
        """
        environment = os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
        self._process = subprocess.Popen(
            self._command,
            stdout=subprocess.PIPE,
            text=True,
            env=environment,
            start_new_session=True,
        )
        line = self._process.stdout.readline() if self._process.stdout else ""
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
        """End the process without warning, as a power cut would."""
        if self._process is not None:
            self._process.send_signal(signal.SIGKILL)
            self._process.wait()

    def close(self) -> None:
        """End the process; does nothing when it has ended already."""
        if self._process is None:
            return
        self._process.terminate()
        try:
            self._process.wait(timeout=5.0)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        if self._process.stdout is not None:
            self._process.stdout.close()
        self._process = None
