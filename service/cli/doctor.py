"""`canopy doctor`."""

import json

import typer

from service.cli.shell import AsJson, Exit
from service.doctor import examine


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
