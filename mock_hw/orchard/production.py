"""Many recordings by several processes, so that it can be stopped and gone on with at any moment.

Every recording is made in a folder of its own inside the data set, and gets its name when it is
finished; only then does the manifest list it.
"""

import os
import shutil
import tempfile
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, wait
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from canopy_skel.errors import RecordingError
from mock_hw.orchard.dataset import (
    LeafyTree,
    Recorded,
    Settings,
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
from mock_hw.orchard.workers import alone_in, require_jobs, workers

_UNFINISHED = ".unfinished-"


@dataclass(frozen=True, kw_only=True, slots=True)
class Produced:
    """One recording of the data set. made: in this run; otherwise it was there already."""

    recorded: Recorded
    made: bool


@dataclass(frozen=True, kw_only=True, slots=True)
class _Order:
    """What a worker needs to know to make one recording."""

    tree: LeafyTree
    settings: Settings
    software: str
    fit: FoliageFit
    folder: Path
    unfinished: Path


def produce(
    folder: Path, wanted: Sequence[LeafyTree], settings: Settings, *, software: str, jobs: int
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
    require_jobs(jobs)
    require_possible(wanted, settings)
    with alone_in(folder):
        listed = finished(folder, settings, software)
        kept = [
            listed[tree]
            for tree in wanted
            if tree in listed and flaw_of(folder, listed[tree]) is None
        ]
        missing = [tree for tree in wanted if tree not in {one.tree for one in kept}]
        for tree in missing:
            if tree not in listed and (folder / tree.file).exists():
                require_ours(folder / tree.file, tree, settings, software)
        for one in kept:
            yield Produced(recorded=one, made=False)
        listed = {tree: one for tree, one in listed.items() if tree not in missing}
        write_manifest(folder, listed.values(), settings, software)
        with _unfinished_in(folder) as unfinished:
            order = partial(
                _Order, settings=settings, software=software, folder=folder, unfinished=unfinished
            )
            for one in _made(missing, order, jobs):
                listed[one.tree] = one
                write_manifest(folder, listed.values(), settings, software)
                yield Produced(recorded=one, made=True)


def _made(
    missing: Sequence[LeafyTree], order: Callable[..., _Order], jobs: int
) -> Iterator[Recorded]:
    """Yield recordings as they are finished; one fit serves all densities of a tree."""
    trees = deque(_by_tree(missing))
    ready: deque[_Order] = deque()
    fitting: dict[Future[tuple[FoliageFit, ...]], list[LeafyTree]] = {}
    recording: set[Future[Recorded]] = set()
    with workers(jobs) as pool:
        while trees or ready or fitting or recording:
            while len(fitting) + len(recording) < jobs and (ready or trees):
                if ready:
                    recording.add(pool.submit(_make, ready.popleft()))
                else:
                    own = trees.popleft()
                    densities = [tree.foliage for tree in own]
                    job = pool.submit(fit_densities, own[0].species, own[0].topology, densities)
                    fitting[job] = own
            under_way: list[Future[Any]] = [*fitting, *recording]
            wait(under_way, return_when=FIRST_COMPLETED)
            for fitted in [one for one in fitting if one.done()]:
                pairs = zip(fitting.pop(fitted), fitted.result(), strict=True)
                ready.extend(order(tree=tree, fit=fit) for tree, fit in pairs)
            for made in [one for one in recording if one.done()]:
                recording.remove(made)
                yield made.result()


def _by_tree(wanted: Iterable[LeafyTree]) -> list[list[LeafyTree]]:
    trees: dict[tuple[str, int], list[LeafyTree]] = {}
    for tree in wanted:
        trees.setdefault((tree.species, tree.topology), []).append(tree)
    return list(trees.values())


def _make(order: _Order) -> Recorded:
    """Make one recording, in a worker."""
    tree, settings = order.tree, order.settings
    part = order.unfinished / tree.file
    simulation = prepare(tree.options(settings), order.fit)
    truth = record(simulation, part, metadata_of(tree, settings, order.software))
    recorded = Recorded(
        file=tree.file,
        sha256=sha256_of(part),
        bytes=part.stat().st_size,
        species=tree.species,
        topology=tree.topology,
        foliage=tree.foliage,
        views=settings.views,
        leaf_count=order.fit.leaf_count,
        v_det=round(order.fit.v_det, 6),
        v_det_target=order.fit.target,
        segmented=round(segmented_share(truth), 6),
    )
    os.replace(part, order.folder / tree.file)
    return recorded


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
