"""`canopy recover`."""

import json
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from canopy_skel.recording import RecoverReport
from canopy_skel.recording import recover as recover_recording
from service.cli.shell import AsJson, Exit, stderr


def recover(
    source: Annotated[Path, typer.Argument(help="A truncated or damaged recording.")],
    target: Annotated[Path, typer.Argument(help="Where the whole one goes.")],
    as_json: AsJson = False,
) -> None:
    """Rewrite a truncated recording with all that is whole in it; exit code 3 if it lacks some."""
    report = recover_recording(source, target)
    if as_json:
        typer.echo(json.dumps(_jsonable(report), indent=2))
    else:
        typer.echo(
            f"{target}: {report.views_saved} whole views saved, {report.bytes_lost} bytes lost"
        )
    for index in report.views_incomplete:
        stderr.print(f"warning: {source}: of view {index} only a part is left", style="yellow")
    for line in report.damage:
        stderr.print(f"warning: {line}", style="yellow", markup=False)
    if not report.complete:
        raise typer.Exit(Exit.PARTIAL)


def _jsonable(report: RecoverReport) -> dict[str, object]:
    fields = asdict(report)
    return {**fields, "source": str(report.source), "target": str(report.target)}
