"""A batch: what is done already stays, everything else is done, whatever happens to some of it."""

from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path

from service.batch.recordings import Found
from service.batch.rows import Row, RowStore
from service.batch.work import Task, key_of
from service.replay import ReplayRequest

Engine = Callable[[Iterable[Task]], Generator[Row, None, None]]
"""Makes rows of tasks, in any order; to be closed. Tasks are asked for when they are begun."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Batch:
    """Which recordings to replay how, and the folder for the results."""

    recordings: Sequence[Found]
    output: Path
    request: ReplayRequest

    def tasks(self, store: RowStore) -> list[Task]:
        """Return what is to be done: all but what is there, of these settings and this code.

        Raises:
            UsageError: the weights cannot be read.
        """
        key = key_of(self.request)
        tasks = (
            Task(found=one, output=self.output, request=self.request, key=key, known=None)
            for one in self.recordings
        )
        tasks = (replace(task, known=_known(task, store)) for task in tasks)
        return [task for task in tasks if not _is_done(task)]

    def rows(self, store: RowStore) -> list[Row]:
        """Return the rows that are there, in the order of the recordings."""
        rows = (store.get(one.name.as_posix()) for one in self.recordings)
        return [row for row in rows if row is not None]


def _known(task: Task, store: RowStore) -> Row | None:
    """Return a row that is good if the recording has not changed."""
    row = store.get(task.name)
    if row is None or row.key != task.key or row.error:
        return None
    return row if all((task.folder / file).exists() for file in row.files) else None


def _is_done(task: Task) -> bool:
    """Say whether the recording looks as it did when its row was made."""
    if task.known is None:
        return False
    try:
        facts = task.found.path.stat()
    except OSError:
        return False
    seen = task.known.size_bytes, task.known.modified_ns
    return seen == (facts.st_size, facts.st_mtime_ns)


def run(
    batch: Batch,
    store: RowStore,
    engine: Engine,
    progress: Callable[[int, int, Row | None], None],
) -> None:
    """Make the rows that the store lacks.

    `progress(done, total, row)` is called at first, and after each recording; its row is on disk
    then.

    Raises:
        UsageError: the weights cannot be read.
    """
    tasks, total = batch.tasks(store), len(batch.recordings)
    done = total - len(tasks)
    progress(done, total, None)
    with closing(engine(_begun(tasks, store))) as rows:
        for row in rows:
            store.add(row)
            done += 1
            progress(done, total, row)


def _begun(tasks: Iterable[Task], store: RowStore) -> Iterator[Task]:
    for task in tasks:
        store.begin(task.name)
        yield task
