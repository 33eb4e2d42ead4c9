"""`canopy scan`."""

import json
from pathlib import Path
from typing import Annotated

import typer

from canopy_skel.cluster import FARTHEST_M
from canopy_skel.pipeline import DEFAULT_METHOD, METHODS
from service.access_keys import read_key
from service.cli.shell import AsJson, Exit, Farthest, Out, progress_bars, stderr, within
from service.outputs import require_writable, write_all
from service.rig import ScanStatus
from service.skeletons import SEGMENTERS


def scan(
    output: Out,
    tree: Annotated[str, typer.Option(help="Which tree this is.")] = "tree",
    path: Annotated[str, typer.Option(help="Named path of waypoints.")] = "orchard-10",
    method: Annotated[str, typer.Option(help=f"One of {', '.join(METHODS)}.")] = DEFAULT_METHOD,
    segmenter: Annotated[
        str | None,
        typer.Option(help=f"One of {', '.join(SEGMENTERS)}; without, what suits the camera."),
    ] = None,
    voxel: Annotated[
        float,
        typer.Option(help="Voxel size of the map in metres.", callback=within(0.001, 0.05)),
    ] = 0.005,
    farthest: Farthest = FARTHEST_M,
    rooted: Annotated[
        bool,
        typer.Option("--rooted", help="Join everything into one tree, however unsure (canopy)."),
    ] = False,
    fragments: Annotated[
        bool, typer.Option(help="Use small wood outside the masks (method canopy).")
    ] = True,
    speed: Annotated[
        float | None,
        typer.Option(help="Of flange and tool in m/s; without, 0.25 or the rig's cap."),
    ] = None,
    url: Annotated[str, typer.Option(help="The service.")] = "http://127.0.0.1:8000",
    key_file: Annotated[
        Path | None, typer.Option(help="File with the service's key, if it has one.")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Start a scan over HTTP, show how it goes, and fetch its recording and skeleton."""
    # Imported here: only this command talks HTTP.
    from service.scan_client import ScanEvent, fetch
    from service.scan_client import scan as run_scan

    require_writable(output)
    key = None if key_file is None else read_key(key_file)
    with progress_bars() as progress:
        task = progress.add_task(tree, total=None)

        def show(event: ScanEvent) -> None:
            status = event.status
            progress.update(task, completed=status.views_done, total=status.views_total)
            if event.kind in ("retake", "stopped", "failed"):
                stderr.print(f"{event.kind}: {status.detail or dict(event.fields)}", markup=False)

        body = {
            "tree_id": tree,
            "path": path,
            "method": method,
            "voxel_size_m": voxel,
            "segmenter": segmenter,
            "farthest_m": farthest,
            "rooted": rooted,
            "fragments": fragments,
            "speed_mps": speed,
        }
        result = run_scan(url, body, show, key=key)
    status = result.status
    contents = {f"{status.scan_id}.mcap": fetch(url, f"/v1/scans/{status.scan_id}/recording.mcap")}
    if result.skeleton is not None:
        contents[f"{status.scan_id}.skeleton.json"] = result.skeleton
    _report(status, [str(file) for file in write_all(output, contents)], as_json=as_json)
    if status.state != "done":
        raise typer.Exit(Exit.FAILED)
    if not result.complete:
        stderr.print("warning: the worker has not finished the skeleton of all views")
        raise typer.Exit(Exit.PARTIAL)


def _report(status: ScanStatus, files: list[str], *, as_json: bool) -> None:
    if as_json:
        typer.echo(json.dumps({"scan_id": status.scan_id, "state": status.state, "files": files}))
        return
    typer.echo(
        f"scan {status.scan_id} is {status.state}: {status.views_done} of"
        f" {status.views_total} views" + (f"; {status.detail}" if status.detail else "")
    )
    for file in files:
        typer.echo(f"  {file}")
