"""`canopy inspect`."""

import json
from pathlib import Path

import typer

from service.cli.shell import AsJson, Exit, topic_options
from service.inspection import describe, inspect_recording


def inspect(recording: Path, topic: list[str] | None = None, as_json: AsJson = False) -> None:
    """Say what a recording holds and which of its views are usable."""
    facts = inspect_recording(recording, topic_options(topic or []))
    typer.echo(json.dumps(facts, indent=2) if as_json else describe(facts))
    if facts["warnings"] or facts["unusable_views"]:
        raise typer.Exit(Exit.PARTIAL)
