"""All rows of an experiment: those that are there, the others made by several processes."""

import multiprocessing
import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from itertools import product
from operator import attrgetter
from pathlib import Path

import cv2

from canopy_skel.errors import UsageError
from canopy_skel.pipeline import METHODS, MethodConfig, MethodName
from service.experiment.measure import Task, rows_of
from service.experiment.orchard import Orchard, Tree
from service.experiment.rows import Row, RowStore, key_of
from service.experiment.segmenters import segmenter_named
from service.memory import keep_freed_memory

MEMORY_LIMIT_BYTES = 3 << 30
_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


@dataclass(frozen=True, kw_only=True, slots=True)
class Experiment:
    """What to compare on an orchard. jobs: how many processes."""

    folder: Path
    orchard: Orchard
    methods: tuple[MethodName, ...]
    segmenters: tuple[str, ...]
    jobs: int = 2

    def __post_init__(self) -> None:
        """Refuse what nobody knows before any work is done."""
        for name in self.methods:
            if name not in METHODS:
                raise UsageError(f"unknown method {name!r}: choose from {', '.join(METHODS)}")
        for segmenter in self.segmenters:
            segmenter_named(segmenter)
        if not (self.methods and self.segmenters):
            raise UsageError("give at least one method and one segmenter")
        if self.jobs < 1:
            raise UsageError(f"{self.jobs} jobs: give 1 or more")

    def keys(self, tree: Tree, segmenter: str) -> list[tuple[MethodName, str]]:
        """Return the methods and the keys of their rows."""
        return [
            (name, key_of(tree, segmenter, name, MethodConfig(name=name).sha256()))
            for name in self.methods
        ]

    def all_keys(self) -> list[str]:
        """Return the keys of all rows, in the order of the table."""
        pairs = product(self.orchard.trees, self.segmenters)
        return [key for tree, segmenter in pairs for _, key in self.keys(tree, segmenter)]


def run(
    experiment: Experiment, store: RowStore, progress: Callable[[int, int, str], None]
) -> list[Row]:
    """Make the rows that the store lacks, and return all of them.

    `progress(done, total, tree)` is called after each tree; its rows are on disk then.
    """
    tasks = list(_tasks(experiment, store))
    done = len(experiment.orchard.trees) - len(tasks)
    progress(done, len(experiment.orchard.trees), "")
    with store.adding() as add:
        for task, rows in _results(tasks, experiment.jobs):
            for row in rows:
                add(row)
            done += 1
            progress(done, len(experiment.orchard.trees), task.tree.name)
    return store.get(experiment.all_keys())


def _tasks(experiment: Experiment, store: RowStore) -> Iterator[Task]:
    """Yield what is lacking, topology by topology: an interrupted run has some of everything."""
    order = attrgetter("topology", "foliage", "species")
    for tree in sorted(experiment.orchard.trees, key=order):
        lacking = {
            segmenter: tuple(n for n, key in experiment.keys(tree, segmenter) if key not in store)
            for segmenter in experiment.segmenters
        }
        lacking = {segmenter: names for segmenter, names in lacking.items() if names}
        if lacking:
            yield Task(
                folder=experiment.folder,
                tree=tree,
                methods=lacking,
                memory_limit_bytes=MEMORY_LIMIT_BYTES,
            )


def _results(tasks: Sequence[Task], jobs: int) -> Iterator[tuple[Task, list[Row]]]:
    if jobs == 1 or len(tasks) < 2:
        for task in tasks:
            yield task, rows_of(task)
        return
    for name in _THREADS:
        os.environ.setdefault(name, "1")  # Of the processes that are about to start.
    spawn = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(min(jobs, len(tasks)), spawn, _begin) as pool:
        try:
            waiting = {pool.submit(rows_of, task): task for task in tasks}
            for future in as_completed(waiting):
                yield waiting[future], future.result()
        finally:
            pool.shutdown(wait=False, cancel_futures=True)


def _begin() -> None:
    cv2.setNumThreads(1)
    keep_freed_memory()
