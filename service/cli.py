"""`canopy`: the command line. Progress on stderr, results on stdout.

Exit codes: 0 ok, 1 failed, 2 usage, 3 partial (something was left out, and said).
"""

import json
import sys
from collections.abc import Callable
from dataclasses import asdict, replace
from enum import IntEnum
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from canopy_skel.document import SkeletonDocument, from_json
from canopy_skel.errors import CanopyError, DocumentError, UsageError
from canopy_skel.exports import FORMATS
from canopy_skel.likelihood import LikelihoodConfig
from canopy_skel.metrics import score as score_document
from canopy_skel.pipeline import METHODS, MethodConfig
from canopy_skel.recording import RecoverReport, TopicOptions, read_recording
from canopy_skel.recording import recover as recover_recording
from service.doctor import available_memory_bytes, examine
from service.inspection import describe, inspect_recording
from service.outputs import require_writable, write_all
from service.replay import ReplayRequest, ReplayResult
from service.replay import replay as replay_recording

app = typer.Typer(
    name="canopy",
    help="Skeletons of leafy orchard trees from one-sided robot scans.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    add_completion=False,
)
stderr = Console(stderr=True, highlight=False, soft_wrap=True)
MOST_MAP_MEMORY = 3 << 30
AsJson = Annotated[bool, typer.Option("--json", help="Print the result as JSON on stdout.")]
Out = Annotated[Path, typer.Option("-o", "--output", help="Folder for the results.")]


class Exit(IntEnum):
    """What a caller learns from the exit code."""

    OK = 0
    FAILED = 1
    USAGE = 2
    PARTIAL = 3


def main() -> None:
    """Run the command line; what is the input's fault ends as one line on stderr."""
    try:
        app()
    except CanopyError as error:
        _complain(error)
        sys.exit(Exit.USAGE if isinstance(error, UsageError) else Exit.FAILED)


@app.command()
def replay(
    recordings: Annotated[list[Path], typer.Argument(metavar="REC...", help="MCAP recordings.")],
    output: Out,
    method: Annotated[str, typer.Option(help=f"One of {', '.join(METHODS)}.")] = "paper",
    segmenter: Annotated[str, typer.Option(help="Where branch masks come from.")] = "recorded",
    voxel: Annotated[float, typer.Option(help="Voxel size of the map in metres.")] = 0.005,
    formats: Annotated[str, typer.Option(help=f"Of {','.join(FORMATS)}.")] = "json,glb",
    topic: Annotated[
        list[str] | None,
        typer.Option(help="ROLE=NAME, e.g. color_image=/rgb or base_frame=base_link; repeatable."),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Turn recordings into skeletons, with an overlay picture and a summary for each."""
    request = ReplayRequest(
        config=MethodConfig(
            name=method,  # type: ignore[arg-type]  # MethodConfig names the known ones
            likelihood=LikelihoodConfig(voxel_size_m=voxel),
        ),
        segmenter=segmenter,
        formats=tuple(formats.split(",")),
        topics=topic_options(topic or []),
        memory_limit_bytes=min(available_memory_bytes() // 2, MOST_MAP_MEMORY),
    )
    _require_distinct_stems(recordings)
    require_writable(output)
    results: list[dict[str, object]] = []
    codes = [_replay_one(path, output, request, results, quiet=as_json) for path in recordings]
    if as_json:
        typer.echo(json.dumps(results, indent=2))
    raise typer.Exit(_overall(codes))


def _replay_one(
    path: Path,
    output: Path,
    request: ReplayRequest,
    results: list[dict[str, object]],
    *,
    quiet: bool,
) -> Exit:
    try:
        with _progress() as progress:
            task = progress.add_task(path.name, total=None)
            result = replay_recording(path, output, request, _advance(progress, task))
    except UsageError:
        raise
    except CanopyError as error:
        _complain(error)
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


@app.command()
def inspect(recording: Path, topic: list[str] | None = None, as_json: AsJson = False) -> None:
    """Say what a recording holds and which of its views are usable."""
    facts = inspect_recording(recording, topic_options(topic or []))
    typer.echo(json.dumps(facts, indent=2) if as_json else describe(facts))
    if facts["warnings"] or facts["unusable_views"]:
        raise typer.Exit(Exit.PARTIAL)


@app.command()
def score(
    skeleton: Annotated[Path, typer.Argument(help="A skeleton document.")],
    truth: Annotated[Path, typer.Argument(help="The true one, or a recording it is attached to.")],
    tolerance: Annotated[float, typer.Option(help="Metres within which points match.")] = 0.02,
    as_json: AsJson = False,
) -> None:
    """Score a skeleton against the truth: the paper's figures and the stricter ones."""
    scores = score_document(_document(skeleton), _truth(truth), tolerance_m=tolerance).to_dict()
    if as_json:
        typer.echo(json.dumps(scores, indent=2))
        return
    width = max(map(len, scores))
    for name, value in scores.items():
        shown = f"{value:.4f}" if isinstance(value, float) else str(value)
        typer.echo(f"{name:{width}}  {shown}")


@app.command()
def recover(
    source: Annotated[Path, typer.Argument(help="A truncated or damaged recording.")],
    target: Annotated[Path, typer.Argument(help="Where the whole one goes.")],
    as_json: AsJson = False,
) -> None:
    """Rewrite a truncated recording with all that is whole in it."""
    report = recover_recording(source, target)
    if as_json:
        typer.echo(json.dumps(jsonable(report), indent=2))
    else:
        typer.echo(
            f"{target}: {report.views_saved} whole views saved, {report.bytes_lost} bytes lost"
        )
    for index in report.views_incomplete:
        stderr.print(f"warning: {source}: of view {index} only a part is left", style="yellow")
    for line in report.damage:
        stderr.print(f"warning: {line}", style="yellow", markup=False)
    if report.damage:
        raise typer.Exit(Exit.PARTIAL)


@app.command()
def export(
    skeleton: Annotated[Path, typer.Argument(help="A skeleton document (JSON).")],
    output: Out,
    formats: Annotated[str, typer.Option(help=f"Of {','.join(FORMATS)}.")] = "glb,swc,ply,csv",
) -> None:
    """Write a skeleton document in other formats."""
    names = formats.split(",")
    for name in names:
        if name not in FORMATS:
            raise UsageError(f"unknown format {name!r}: choose from {', '.join(FORMATS)}")
    document = _document(skeleton)
    require_writable(output)
    stem = skeleton.name.removesuffix(".json").removesuffix(".skeleton")
    contents = {f"{stem}.skeleton.{name}": FORMATS[name](document) for name in names}
    for file in write_all(output, contents):
        typer.echo(file)


@app.command()
def serve(
    sim: Annotated[
        bool, typer.Option("--sim", help="A simulated arm before a grown tree.")
    ] = False,
    robot: Annotated[str | None, typer.Option(help="Address of the UR controller.")] = None,
    host: Annotated[str, typer.Option(help="Address to listen on.")] = "127.0.0.1",
    port: Annotated[int, typer.Option(help="Port to listen on.")] = 8000,
    data: Annotated[Path, typer.Option(help="Folder of recordings and catalogue.")] = Path("data"),
    site: Annotated[str, typer.Option(help="Name of the site on the bus.")] = "orchard",
    rig: Annotated[str, typer.Option(help="Name of the rig on the bus.")] = "rig-1",
    species: Annotated[str, typer.Option(help="Simulated tree: apple, oak, walnut.")] = "apple",
    topology: Annotated[int, typer.Option(help="Which tree of the species.")] = 0,
    leaves: Annotated[int, typer.Option(help="How many leaves it bears.")] = 500,
    time_scale: Annotated[float, typer.Option(help="Simulated arm: times real speed.")] = 1.0,
    picture_scale: Annotated[float, typer.Option(help="Size of simulated pictures.")] = 1.0,
) -> None:
    """Run the scan service: the rig over HTTP, with a worker that makes skeletons."""
    # Only this command needs hardware, simulation and web, which take long to load.
    from mock_hw.orchard.simulate import Options
    from service.compose import ServeOptions, composed
    from service.server import make_server

    if sim == (robot is not None):
        raise UsageError("give either --sim or --robot HOST")
    require_writable(data)
    options = ServeOptions(
        data=data,
        robot=robot,
        site=site,
        rig=rig,
        orchard=Options(species=species, topology=topology, leaf_count=leaves, weather="fair"),
        time_scale=time_scale,
        picture_scale=picture_scale,
    )
    with composed(options) as service:
        make_server(service, host=host, port=port).run()


@app.command(context_settings={"ignore_unknown_options": True, "help_option_names": []})
def worker(arguments: Annotated[list[str] | None, typer.Argument()] = None) -> None:
    """Run a skeleton worker by itself: --connect ENDPOINT --site SITE --rig RIG [--id ID]."""
    # Imported here: only workers need the bus.
    from service.worker import main as run_worker

    run_worker(arguments or [])


@app.command()
def scan(
    output: Out,
    tree: Annotated[str, typer.Option(help="Which tree this is.")] = "tree",
    path: Annotated[str, typer.Option(help="Named path of waypoints.")] = "orchard-10",
    method: Annotated[str, typer.Option(help=f"One of {', '.join(METHODS)}.")] = "paper",
    voxel: Annotated[float, typer.Option(help="Voxel size of the map in metres.")] = 0.005,
    url: Annotated[str, typer.Option(help="The service.")] = "http://127.0.0.1:8000",
    as_json: AsJson = False,
) -> None:
    """Start a scan over HTTP, show how it goes, and fetch its recording and skeleton."""
    # Imported here: only this command talks HTTP.
    from service.scan_client import ScanEvent, fetch
    from service.scan_client import scan as run_scan

    require_writable(output)
    with _progress() as progress:
        task = progress.add_task(tree, total=None)

        def show(event: ScanEvent) -> None:
            status = event.status
            progress.update(task, completed=status.views_done, total=status.views_total)
            if event.kind in ("retake", "stopped", "failed"):
                stderr.print(f"{event.kind}: {status.detail or dict(event.fields)}", markup=False)

        body = {"tree_id": tree, "path": path, "method": method, "voxel_size_m": voxel}
        result = run_scan(url, body, show)
    status = result.status
    contents = {f"{status.scan_id}.mcap": fetch(url, f"/v1/scans/{status.scan_id}/recording.mcap")}
    if result.skeleton is not None:
        contents[f"{status.scan_id}.skeleton.json"] = result.skeleton
    files = [str(file) for file in write_all(output, contents)]
    if as_json:
        typer.echo(json.dumps({"scan_id": status.scan_id, "state": status.state, "files": files}))
    else:
        typer.echo(
            f"scan {status.scan_id} is {status.state}: {status.views_done} of"
            f" {status.views_total} views" + (f"; {status.detail}" if status.detail else "")
        )
        for file in files:
            typer.echo(f"  {file}")
    if status.state != "done":
        raise typer.Exit(Exit.FAILED)
    if not result.complete:
        stderr.print("warning: the worker has not finished the skeleton of all views")
        raise typer.Exit(Exit.PARTIAL)


@app.command()
def doctor(as_json: AsJson = False) -> None:
    """Check that this machine has what canopy needs."""
    findings = examine()
    if as_json:
        typer.echo(json.dumps([finding.to_dict() for finding in findings], indent=2))
    else:
        for finding in findings:
            typer.echo(f"{'ok  ' if finding.ok else 'FAIL'}  {finding.name}: {finding.detail}")
    if not all(finding.ok for finding in findings):
        raise typer.Exit(Exit.FAILED)


def jsonable(report: RecoverReport) -> dict[str, object]:
    """Return the fields of a report, ready for JSON."""
    fields = asdict(report)
    return {**fields, "source": str(report.source), "target": str(report.target)}


def topic_options(assignments: list[str]) -> TopicOptions | None:
    """Return the topic options that ROLE=NAME assignments stand for; None if there are none.

    Raises:
        UsageError: a role is unknown, or its value does not fit.
    """
    changes: dict[str, Any] = {}
    for assignment in assignments:
        role, _, value = assignment.partition("=")
        if role not in TopicOptions.__slots__ or not value:
            roles = ", ".join(TopicOptions.__slots__)
            raise UsageError(f"--topic {assignment}: give ROLE=NAME with a role of {roles}")
        changes[role] = _like(getattr(TopicOptions(), role), value, assignment)
    return replace(TopicOptions(), **changes) if changes else None


def _like(known: object, value: str, assignment: str) -> object:
    if isinstance(known, bool):
        if value not in ("true", "false"):
            raise UsageError(f"--topic {assignment}: give true or false")
        return value == "true"
    if isinstance(known, int):
        if not value.isdecimal():
            raise UsageError(f"--topic {assignment}: give whole nanoseconds")
        return int(value)
    return value


def _document(path: Path) -> SkeletonDocument:
    try:
        data = path.read_bytes()
    except OSError as error:
        raise DocumentError(f"{path}: cannot be read ({error.strerror}); check the path") from error
    return from_json(data, str(path))


def _truth(path: Path) -> SkeletonDocument:
    if path.suffix != ".mcap":
        return _document(path)
    data = read_recording(path).ground_truth
    if data is None:
        raise DocumentError(
            f"{path}: no ground_truth_skeleton.json is attached; give the true skeleton's JSON"
        )
    return from_json(data, f"{path}: ground_truth_skeleton.json")


def _require_distinct_stems(recordings: list[Path]) -> None:
    stems = [path.stem for path in recordings]
    for stem in stems:
        if stems.count(stem) > 1:
            raise UsageError(
                f"several recordings are named {stem}: their results would overwrite each other;"
                " replay them into different folders"
            )


def _overall(codes: list[Exit]) -> Exit:
    if len(set(codes)) == 1:
        return codes[0]
    return Exit.PARTIAL


def _progress() -> Progress:
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn())
    quiet = not stderr.is_terminal
    return Progress(*columns, TimeElapsedColumn(), console=stderr, transient=True, disable=quiet)


def _complain(error: CanopyError) -> None:
    stderr.print(f"error: {error}", style="red", markup=False)
