"""Processes that do one task at a time each; if one dies, that costs its task and no other."""

import multiprocessing
import signal
from collections.abc import Callable, Generator, Iterable, Iterator
from contextlib import contextmanager, suppress
from itertools import islice
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection, wait
from multiprocessing.context import SpawnProcess
from typing import Generic, TypeVar

from mock_hw.orchard.workers import begin_work, one_thread_each

T = TypeVar("T")
R = TypeVar("R")
_DYING_S = 5.0
"""How long a process may take to end after it has closed its connection."""


class _Lane(Generic[T, R]):
    """One process after another: the next begins when one has died. task: what it is at."""

    def __init__(self, work: Callable[[T], R]) -> None:
        self._work = work
        self._process: SpawnProcess | None = None

    def begin(self, task: T) -> None:
        """Begin with a task."""
        self.task = task
        if self._process is None:
            self._start()
        with suppress(BrokenPipeError):  # It has died since, and `result` will say so.
            self.connection.send(task)

    def result(self, died: Callable[[T, int | None], R]) -> R:
        """Wait for the result."""
        try:
            result: R = self.connection.recv()
        except (EOFError, ConnectionResetError):
            return died(self.task, self.end(_DYING_S))
        return result

    def end(self, patience_s: float = 0.0) -> int | None:
        """End the process, whatever it is doing, and return its exit code."""
        if self._process is None:
            return None
        self._process.join(patience_s)
        self._process.kill()
        self._process.join()
        self.connection.close()
        process, self._process = self._process, None
        return process.exitcode

    def _start(self) -> None:
        spawn = multiprocessing.get_context("spawn")
        self.connection, theirs = spawn.Pipe()
        with one_thread_each(), _interrupts_later(), theirs:
            self._process = spawn.Process(target=_serve, args=(theirs, self._work), daemon=True)
            self._process.start()


@contextmanager
def _interrupts_later() -> Iterator[None]:
    """Put Ctrl-C off; processes that start meanwhile do not hear it before they begin to work.

    Until then each would say in forty lines where it was interrupted.
    """
    resource_tracker.ensure_running()  # As it starts it lets Ctrl-C through.
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _serve(connection: Connection, work: Callable[[T], R]) -> None:
    begin_work()
    with suppress(EOFError):
        while True:
            connection.send(work(connection.recv()))


def in_lanes(
    work: Callable[[T], R],
    tasks: Iterable[T],
    processes: int,
    died: Callable[[T, int | None], R],
) -> Generator[R, None, None]:
    """Yield results as they come. A task is asked for when there is a process for it.

    A process that dies is replaced, and `died(task, exit code)` is the result. That is called, too,
    of what is under way when the caller has had enough: then the processes are killed.
    """
    waiting = iter(tasks)
    lanes = [_Lane[T, R](work) for _ in range(processes)]
    busy: list[_Lane[T, R]] = []

    def begin(lane: _Lane[T, R]) -> None:
        for task in islice(waiting, 1):
            lane.begin(task)
            busy.append(lane)

    try:
        for lane in lanes:
            begin(lane)
        while busy:
            ready = wait([lane.connection for lane in busy])
            for lane in [one for one in busy if one.connection in ready]:
                result = lane.result(died)
                busy.remove(lane)
                yield result
                begin(lane)
    finally:
        for lane in lanes:
            code = lane.end()
            if lane in busy:
                died(lane.task, code)
