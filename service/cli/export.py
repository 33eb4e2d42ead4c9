"""`canopy export`."""

from pathlib import Path
from typing import Annotated

import typer

from canopy_skel.errors import UsageError
from canopy_skel.exports import FORMATS
from service.cli.documents import read_document
from service.cli.shell import Out
from service.outputs import require_writable, write_all


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
    document = read_document(skeleton)
    require_writable(output)
    stem = skeleton.name.removesuffix(".json").removesuffix(".skeleton")
    contents = {f"{stem}.skeleton.{name}": FORMATS[name](document) for name in names}
    for file in write_all(output, contents):
        typer.echo(file)
