"""Many recordings by several processes, so that it can be stopped and gone on with at any moment.

Every recording is made in a folder of its own inside the data set, and gets its name when it is
finished; only then does the manifest list it.
"""

import fcntl
import multiprocessing
import os
import shutil
import signal
import tempfile
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2

from canopy_skel.errors import RecordingError, UsageError
from mock_hw.orchard.dataset import (
    Recorded,
    Settings,
    Stand,
    finished,
    flaw_of,
    metadata_of,
    require_ours,
    require_possible,
    sha256_of,
    write_manifest,
)
from mock_hw.orchard.foliage import FoliageFit
from mock_hw.orchard.record import record, segmented_share
from mock_hw.orchard.simulate import fit_densities, prepare

_UNFINISHED = ".unfinished-"
_ONE_THREAD = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")


@dataclass(frozen=True, kw_only=True, slots=True)
class Produced:
    """One recording of the data set. made: in this run; otherwise it was there already."""

    recorded: Recorded
    made: bool


@dataclass(frozen=True, slots=True)
class _Order:
    """What a worker needs to know to make one recording."""

    stand: Stand
    settings: Settings
    software: str
    fit: FoliageFit
    folder: Path
    unfinished: Path


def produce(
    folder: Path, wanted: Sequence[Stand], settings: Settings, *, software: str, jobs: int
) -> Iterator[Produced]:
    """Yield the recordings of a data set as they are finished, what is there already first.

    A recording is kept if the manifest lists it and its bytes have not changed; all others are
    made. Recordings in the folder that are not wanted now stay, and stay listed. Bytes do not
    depend on `jobs`, nor on what was made before.

    Args:
        folder: where the recordings and the manifest go; it must be there.
        wanted: the trees, in the order in which they are to be made.
        settings: of all recordings in the folder.
        software: name and version, for the record.
        jobs: how many processes.

    Raises:
        UsageError: an option is out of range, or the folder holds something else.
        RecordingError: a recording or the manifest cannot be written.
    """
    if jobs < 1:
        raise UsageError(f"jobs is {jobs}; give 1 or more")
    require_possible(wanted, settings)
    with _alone_in(folder):
        listed = finished(folder, settings, software)
        kept = [
            listed[stand]
            for stand in wanted
            if stand in listed and flaw_of(folder, listed[stand]) is None
        ]
        missing = [stand for stand in wanted if stand not in {one.stand for one in kept}]
        for stand in missing:
            if stand not in listed and (folder / stand.file).exists():
                require_ours(folder / stand.file, stand, settings, software)
        for one in kept:
            yield Produced(recorded=one, made=False)
        listed = {stand: one for stand, one in listed.items() if stand not in missing}
        write_manifest(folder, listed.values(), settings, software)
        with _unfinished_in(folder) as unfinished:

            def order(stand: Stand, fit: FoliageFit) -> _Order:
                return _Order(stand, settings, software, fit, folder, unfinished)

            for one in _made(missing, order, jobs):
                listed[one.stand] = one
                write_manifest(folder, listed.values(), settings, software)
                yield Produced(recorded=one, made=True)


def _made(
    missing: Sequence[Stand], order: Callable[[Stand, FoliageFit], _Order], jobs: int
) -> Iterator[Recorded]:
    """Yield recordings as they are finished; one fit serves all densities of a tree."""
    trees = deque(_by_tree(missing))
    ready: deque[_Order] = deque()
    fitting: dict[Future[tuple[FoliageFit, ...]], list[Stand]] = {}
    recording: set[Future[Recorded]] = set()
    with _workers(jobs) as pool:
        while trees or ready or fitting or recording:
            while len(fitting) + len(recording) < jobs and (ready or trees):
                if ready:
                    recording.add(pool.submit(_make, ready.popleft()))
                else:
                    own = trees.popleft()
                    densities = [stand.foliage for stand in own]
                    fit = pool.submit(fit_densities, own[0].species, own[0].topology, densities)
                    fitting[fit] = own
            under_way: list[Future[Any]] = [*fitting, *recording]
            wait(under_way, return_when=FIRST_COMPLETED)
            for fit in [one for one in fitting if one.done()]:
                own = fitting.pop(fit)
                ready.extend(map(order, own, fit.result()))
            for made in [one for one in recording if one.done()]:
                recording.remove(made)
                yield made.result()


def _by_tree(wanted: Iterable[Stand]) -> list[list[Stand]]:
    trees: dict[tuple[str, int], list[Stand]] = {}
    for stand in wanted:
        trees.setdefault((stand.species, stand.topology), []).append(stand)
    return list(trees.values())


def _make(order: _Order) -> Recorded:
    """Make one recording, in a worker."""
    stand, settings = order.stand, order.settings
    part = order.unfinished / stand.file
    simulation = prepare(stand.options(settings), order.fit)
    truth = record(simulation, part, metadata_of(stand, settings, order.software))
    recorded = Recorded(
        file=stand.file,
        sha256=sha256_of(part),
        bytes=part.stat().st_size,
        species=stand.species,
        topology=stand.topology,
        foliage=stand.foliage,
        views=settings.views,
        leaf_count=order.fit.leaf_count,
        v_det=round(order.fit.v_det, 6),
        v_det_target=order.fit.target,
        segmented=round(segmented_share(truth), 6),
    )
    os.replace(part, order.folder / stand.file)
    return recorded


@contextmanager
def _workers(jobs: int) -> Iterator[ProcessPoolExecutor]:
    """Start processes that compute on one thread each and do not outlive this one."""
    before = {name: os.environ.get(name) for name in _ONE_THREAD}
    os.environ.update(dict.fromkeys(_ONE_THREAD, "1"))
    spawn = multiprocessing.get_context("spawn")
    try:
        with ProcessPoolExecutor(jobs, mp_context=spawn, initializer=_begin_work) as pool:
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
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


def _begin_work() -> None:
    """Prepare a worker: one thread; gone at once when interrupted, or when its parent is."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    cv2.setNumThreads(1)
    parent = multiprocessing.parent_process()
    if parent is None:
        raise RuntimeError("a worker has a parent")

    def follow() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=follow, name="follow-parent", daemon=True).start()


@contextmanager
def _alone_in(folder: Path) -> Iterator[None]:
    """Hold the folder, so that two runs do not make the same recordings."""
    descriptor = os.open(folder, os.O_RDONLY | os.O_CLOEXEC)
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise UsageError(
                f"{folder}: another canopy simulate writes there; wait for it, or choose another"
                " folder"
            ) from error
        yield
    finally:
        os.close(descriptor)


@contextmanager
def _unfinished_in(folder: Path) -> Iterator[Path]:
    """Make a folder for recordings in the making; clear away what killed runs have left."""
    for leftover in folder.glob(f"{_UNFINISHED}*"):
        shutil.rmtree(leftover, ignore_errors=True)
    try:
        unfinished = Path(tempfile.mkdtemp(prefix=_UNFINISHED, dir=folder))
    except OSError as error:
        raise RecordingError(
            f"{folder}: cannot be written ({error.strerror}); check the disk"
        ) from error
    try:
        yield unfinished
    finally:
        shutil.rmtree(unfinished, ignore_errors=True)
