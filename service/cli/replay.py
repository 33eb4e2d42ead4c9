"""`canopy replay`."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import typer
from rich.progress import Progress

from canopy_skel.cluster import FARTHEST_M
from canopy_skel.errors import CanopyError, UsageError
from canopy_skel.pipeline import DEFAULT_METHOD
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
from service.cli.shell import (
    AsJson,
    Exit,
    Farthest,
    Out,
    complain,
    overall,
    progress_bars,
    stderr,
)
from service.doctor import available_memory_bytes
from service.kernels import compile_kernels
from service.outputs import require_writable
from service.replay import ReplayRequest, ReplayResult
from service.replay import replay as replay_recording


def replay(
    recordings: Annotated[list[Path], typer.Argument(metavar="REC...", help="MCAP recordings.")],
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
    as_json: AsJson = False,
) -> None:
    """Turn recordings into skeletons, with an overlay picture and a summary for each."""
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
        memory_bytes=available_memory_bytes(),
    )
    _require_distinct_stems(recordings)
    require_writable(output)
    compile_kernels([method, segmenter])
    results: list[dict[str, object]] = []
    codes = [_replay_one(path, output, request, results, quiet=as_json) for path in recordings]
    if as_json:
        typer.echo(json.dumps(results, indent=2))
    raise typer.Exit(overall(codes))


def _replay_one(
    path: Path,
    output: Path,
    request: ReplayRequest,
    results: list[dict[str, object]],
    *,
    quiet: bool,
) -> Exit:
    try:
        with progress_bars() as progress:
            task = progress.add_task(path.name, total=None)
            result = replay_recording(path, output, request, _advance(progress, task))
    except UsageError:
        raise
    except CanopyError as error:
        complain(error)
        results.append({"recording": str(path), "error": str(error)})
        return Exit.FAILED
    rejected = (f"{path.name}: {view.reason}" for view in result.document.views_rejected)
    for line in (*result.warnings, *rejected):
        stderr.print(f"warning: {line}", style="yellow", markup=False)
    results.append(_replayed(path, result))
    if not quiet:
        _say_replayed(path, result)
    return Exit.OK if result.complete else Exit.PARTIAL


def _advance(progress: Progress, task: object) -> Callable[[int, int], None]:
    def advance(done: int, total: int) -> None:
        progress.update(task, completed=done, total=total)  # type: ignore[arg-type]

    return advance


def _replayed(path: Path, result: ReplayResult) -> dict[str, object]:
    return {
        "recording": str(path),
        "files": [str(file) for file in result.files],
        "views_used": result.document.views_used,
        "views_rejected": len(result.document.views_rejected),
        "warnings": list(result.warnings),
        "branches": len(result.document.branches),
        "components": result.document.components,
    }


def _say_replayed(path: Path, result: ReplayResult) -> None:
    document = result.document
    length_m = sum(branch.length for branch in document.branches)
    typer.echo(
        f"{path.name}: {length_m:.1f} m of skeleton in {len(document.branches)} branches"
        f" from {document.views_used} views"
    )
    for file in result.files:
        typer.echo(f"  {file}")


def _require_distinct_stems(recordings: list[Path]) -> None:
    stems = [path.stem for path in recordings]
    for stem in stems:
        if stems.count(stem) > 1:
            raise UsageError(
                f"several recordings are named {stem}: their results would overwrite each other;"
                " replay them into different folders"
            )
