"""`canopy batch`."""

import json
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated

import typer
from rich.progress import Progress, TaskID

from canopy_skel.cluster import FARTHEST_M
from canopy_skel.errors import UsageError
from canopy_skel.pipeline import DEFAULT_METHOD
from mock_hw.orchard.workers import require_jobs
from service.batch.local import default_jobs, rows_here
from service.batch.recordings import find_recordings
from service.batch.rows import Row, row_store, rows_csv
from service.batch.run import Batch, Engine, run
from service.cli.replay_options import (
    VOXEL_M,
    Formats,
    Fragments,
    Method,
    Rooted,
    SegmenterName,
    Topics,
    Voxel,
    Weights,
    replay_request,
)
from service.cli.shell import AsJson, Exit, Farthest, Out, overall, progress_bars, stderr
from service.doctor import available_memory_bytes
from service.kernels import compile_kernels
from service.outputs import require_writable, write_all
from service.segmenters import make_segmenter

STORE = "batch.jsonl"
TABLE = "batch.csv"
_CODES: dict[str, Exit] = {"ok": Exit.OK, "partial": Exit.PARTIAL, "failed": Exit.FAILED}


def batch(
    paths: Annotated[
        list[Path],
        typer.Argument(metavar="PATH...", help="MCAP recordings, or folders to search for them."),
    ],
    output: Out,
    method: Method = DEFAULT_METHOD,
    segmenter: SegmenterName = "recorded",
    weights: Weights = None,
    voxel: Voxel = VOXEL_M,
    formats: Formats = "json,glb",
    topic: Topics = None,
    fragments: Fragments = True,
    farthest: Farthest = FARTHEST_M,
    rooted: Rooted = False,
    jobs: Annotated[
        int | None,
        typer.Option(help="How many processes; one a core by default, if memory suffices."),
    ] = None,
    cluster: Annotated[
        str | None,
        typer.Option(metavar="ADDRESS", help="Dask scheduler to use, e.g. tcp://host:8786."),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Replay many recordings, with a table of what became of each.

    Run again after an interruption, it goes on where it stopped, and tries again what failed.
    """
    if jobs is not None and cluster is not None:
        raise UsageError("--jobs is for this machine; leave it out with --cluster")
    if weights is not None:
        weights = weights.absolute()  # The workers of a cluster are in folders of their own.
    processes = default_jobs() if jobs is None else jobs
    require_jobs(processes)
    request = replay_request(
        method=method,
        segmenter=segmenter,
        weights=weights,
        voxel_m=voxel,
        formats=formats,
        topics=topic,
        fragments=fragments,
        farthest_m=farthest,
        rooted=rooted,
        memory_bytes=available_memory_bytes() // processes,
    )
    make_segmenter(segmenter, weights)  # Whether it can be made is the same for all recordings.
    recordings = find_recordings(paths)
    plan = Batch(recordings=recordings, output=output.absolute(), request=request)
    with _engine(cluster, processes) as engine:
        require_writable(output)
        compile_kernels([method, segmenter])
        rows = _run(plan, engine)
    _report(output / TABLE, rows, as_json=as_json)
    raise typer.Exit(overall([_CODES[row.status] for row in rows]))


@contextmanager
def _engine(cluster: str | None, processes: int) -> Iterator[Engine]:
    if cluster is None:
        yield partial(rows_here, jobs=processes)
        return
    if find_spec("distributed") is None:
        raise UsageError("--cluster needs Dask: pip install 'canopy-skel[cluster]'")
    # Imported here: few installations have it.
    from service.batch.cluster import connected, rows_there

    with connected(cluster) as client:
        yield partial(rows_there, client=client)


def _run(plan: Batch, engine: Engine) -> list[Row]:
    with row_store(plan.output / STORE) as store, progress_bars() as progress:
        try:
            run(plan, store, engine, _show(progress, progress.add_task("recordings", total=None)))
        except KeyboardInterrupt:
            stderr.print("interrupted; the same command goes on where this one stopped")
            raise
        finally:
            rows = plan.rows(store)
            write_all(plan.output, {TABLE: rows_csv(rows)})
    return rows


def _show(progress: Progress, task: TaskID) -> Callable[[int, int, Row | None], None]:
    def show(done: int, total: int, row: Row | None) -> None:
        progress.update(task, completed=done, total=total)
        if row is None:
            stderr.print(f"{done} of {total} recordings are done already", markup=False)
        elif row.error:
            stderr.print(f"{done}/{total} error: {row.error}", style="red", markup=False)
        else:
            stderr.print(
                f"{done}/{total} {row.recording}: {row.length_m:.1f} m of skeleton in"
                f" {row.branches} branches, {row.seconds:.0f} s",
                markup=False,
            )
            for line in row.warnings:
                stderr.print(f"warning: {row.recording}: {line}", style="yellow", markup=False)

    return show


def _report(table: Path, rows: list[Row], *, as_json: bool) -> None:
    found = Counter[str](row.status for row in rows)
    counts = {status: found[status] for status in _CODES}
    if as_json:
        recordings = [row.shown() for row in rows]
        typer.echo(json.dumps({"table": str(table), **counts, "recordings": recordings}, indent=2))
    else:
        typer.echo(", ".join(f"{count} {status}" for status, count in counts.items()))
        typer.echo(table)
