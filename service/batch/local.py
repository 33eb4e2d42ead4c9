"""A batch by processes of this machine."""

import os
from collections.abc import Generator, Iterable

from service.batch.lanes import in_lanes
from service.batch.rows import Row
from service.batch.work import Task, row_of
from service.doctor import ENOUGH_MEMORY, available_memory_bytes


def default_jobs() -> int:
    """Return one process a core, or fewer where memory does not suffice for so many."""
    fits = available_memory_bytes() // ENOUGH_MEMORY
    return max(1, min(len(os.sched_getaffinity(0)), fits))


def rows_here(tasks: Iterable[Task], jobs: int) -> Generator[Row, None, None]:
    """Yield rows as they are made by `jobs` processes of one thread each."""
    return in_lanes(row_of, tasks, jobs, _died)


def _died(task: Task, exit_code: int | None) -> Row:
    task.remove_parts()
    how = f"was killed (signal {-exit_code})" if exit_code and exit_code < 0 else "ended"
    return task.failed(
        f"{task.found.path}: the process that replayed it {how}, perhaps for want of memory; run"
        " again with fewer --jobs"
    )
