"""Processes that share the work on one folder, and end with whoever started them."""

import fcntl
import multiprocessing
import os
import signal
import threading
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from pathlib import Path

import cv2

from canopy_skel.errors import RecordingError, UsageError

_ONE_THREAD = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")


def require_jobs(jobs: int) -> None:
    """Check that there is to be a process at all.

    Raises:
        UsageError: there is not.
    """
    if jobs < 1:
        raise UsageError(f"jobs is {jobs}; give 1 or more")


@contextmanager
def workers(jobs: int) -> Iterator[ProcessPoolExecutor]:
    """Start processes that compute on one thread each and do not outlive this one.

    Raises:
        RecordingError: one of them was killed.
    """
    spawn = multiprocessing.get_context("spawn")
    try:
        with (
            one_thread_each(),
            ProcessPoolExecutor(jobs, mp_context=spawn, initializer=begin_work) as pool,
        ):
            try:
                yield pool
            except BaseException:
                pool.shutdown(wait=False, cancel_futures=True)
                raise
    except BrokenProcessPool as error:
        raise RecordingError(
            "a process that simulates was killed, perhaps for want of memory; run again to go on,"
            " with fewer --jobs"
        ) from error


@contextmanager
def one_thread_each() -> Iterator[None]:
    """Have processes that are started meanwhile compute on one thread each."""
    before = {name: os.environ.get(name) for name in _ONE_THREAD}
    os.environ.update(dict.fromkeys(_ONE_THREAD, "1"))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


def begin_work() -> None:
    """Prepare a worker: one thread; gone at once when interrupted, or when its parent is."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
    cv2.setNumThreads(1)
    parent = multiprocessing.parent_process()
    if parent is None:
        raise RuntimeError("a worker has a parent")

    def follow() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=follow, name="follow-parent", daemon=True).start()


@contextmanager
def alone_in(folder: Path) -> Iterator[None]:
    """Hold a folder, so that two runs do not make the same files.

    Raises:
        UsageError: another one holds it.
    """
    descriptor = os.open(folder, os.O_RDONLY | os.O_CLOEXEC)
    try:
        hold(descriptor, folder)
        yield
    finally:
        os.close(descriptor)


def hold(descriptor: int, path: Path) -> None:
    """Hold what is open at `path` until it is closed.

    Raises:
        UsageError: another process holds it.
    """
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        raise UsageError(
            f"{path}: another canopy writes there; wait for it, or choose another folder"
        ) from error
