"""A process of ours with a pipe between us: started, killed, ended, and never left behind.

What must not harm this program (vendor libraries that block, abort or lose their device) runs in
one of these; so does what is simulated.
"""

import os
import subprocess
import sys
from collections.abc import Sequence
from multiprocessing import Pipe
from typing import IO


class Child:
    """A running process; the descriptor of its end of the pipe is its last argument.

    The process has to end when the pipe is closed at our end, which is so as well when we were
    killed: the kernel closes it for us. Ctrl-C does not reach it; we end it in our own time.

    Args:
        command: what to run; Python finds the modules that we find.
        captured: whether `output` is what it writes to its standard output.
    """

    def __init__(self, command: Sequence[str], *, captured: bool = False) -> None:
        self.pipe, theirs = Pipe()
        environment = os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
        with theirs:
            self._process = subprocess.Popen(
                [*command, str(theirs.fileno())],
                pass_fds=[theirs.fileno()],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE if captured else None,
                env=environment,
                start_new_session=True,
            )

    @property
    def pid(self) -> int:
        """Return the process id."""
        return self._process.pid

    @property
    def output(self) -> IO[bytes]:
        """Return what it writes, if that is captured."""
        if self._process.stdout is None:
            raise ValueError("the output of this child is not captured")
        return self._process.stdout

    def send(self, message: object) -> None:
        """Send a message; to a child that is gone it is lost, which reading the pipe tells."""
        try:
            self.pipe.send(message)
        except OSError:
            return

    def kill(self) -> None:
        """End it at once, from any thread; harmless when it has ended."""
        self._process.kill()

    def exit_code(self, timeout_s: float) -> int | None:
        """Return how it ended (-N: by signal N), None if it has not after `timeout_s`."""
        try:
            return self._process.wait(timeout_s)
        except subprocess.TimeoutExpired:
            return None

    def end(self, leave_s: float) -> None:
        """Close the pipe, give it `leave_s` to leave by itself, then kill it."""
        self.pipe.close()
        if self.exit_code(leave_s) is None:
            self.kill()
            self._process.wait()
        if self._process.stdout is not None:
            self._process.stdout.close()
