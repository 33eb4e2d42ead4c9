"""A batch by the workers of a Dask cluster; they see recordings and results at the same paths."""

import uuid
from collections.abc import Generator, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from itertools import islice

from distributed import Client, Future, as_completed, get_worker

from canopy_skel.errors import CanopyError, UsageError
from service.batch.rows import Row
from service.batch.work import Task, row_of
from service.doctor import available_memory_bytes
from service.replay import map_memory_bytes

CONNECTING = "10s"


class ClusterError(CanopyError):
    """The cluster is gone; what it had done is there."""


def rows_there(tasks: Iterable[Task], client: Client) -> Generator[Row, None, None]:
    """Yield rows as they are made by the workers of a cluster.

    No worker has more than one: all that a worker has is lost when it dies.

    Raises:
        ClusterError: the scheduler is gone.
    """
    run, waiting = uuid.uuid4().hex, iter(tasks)
    under_way: dict[Future[Row], Task] = {}
    done = as_completed(loop=client.loop)
    try:
        while True:
            # One waits where there is no worker yet.
            free = max(1, len(_threads(client))) - len(under_way)
            for task in islice(waiting, max(0, free)):
                future = client.submit(_row_on_worker, task, key=f"canopy-{run}-{task.name}")
                under_way[future] = task
                done.add(future)
            if not under_way:
                return
            future = next(done)
            yield _row_of(future, under_way.pop(future))
    finally:
        client.cancel(list(under_way))


@contextmanager
def connected(address: str) -> Iterator[Client]:
    """Connect to the scheduler of a cluster.

    Raises:
        UsageError: it cannot be reached, or its workers do several recordings at once.
    """
    try:
        client = Client(address, timeout=CONNECTING, set_as_default=False)
    except (OSError, ValueError) as error:
        raise UsageError(
            f"--cluster {address}: no Dask scheduler answers there ({error}); start one with `dask"
            " scheduler` and give its address, as in tcp://host:8786"
        ) from error
    with client:
        for worker, threads in _threads(client).items():
            if threads > 1:
                raise UsageError(
                    f"--cluster {address}: worker {worker} has {threads} threads; start workers"
                    " with `dask worker --nthreads 1 --nworkers N`"
                )
        yield client


def _threads(client: Client) -> dict[str, int]:
    """Return how many threads each worker has."""
    try:
        threads: dict[str, int] = client.nthreads()
    except OSError as error:
        raise ClusterError(
            f"the scheduler of the cluster is gone ({error}); start another, and run the same"
            " command again to go on"
        ) from error
    return threads


def _row_on_worker(task: Task) -> Row:
    """Replay a recording with the memory that this worker may use."""
    limit = get_worker().memory_manager.memory_limit or available_memory_bytes()
    request = replace(task.request, memory_limit_bytes=map_memory_bytes(limit))
    return row_of(replace(task, request=request))


def _row_of(future: Future[Row], task: Task) -> Row:
    try:
        return future.result()
    except Exception as error:  # A worker that died, a scheduler that is gone, other versions, …
        reason = " ".join(str(error).split())
        return task.failed(f"{task.found.path}: the cluster could not do it ({reason})")
