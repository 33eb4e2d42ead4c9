"""`canopy score`."""

import json
from pathlib import Path
from typing import Annotated

import typer

from canopy_skel.metrics import score as score_document
from service.cli.documents import read_document, read_truth
from service.cli.shell import AsJson


def score(
    skeleton: Annotated[Path, typer.Argument(help="A skeleton document.")],
    truth: Annotated[Path, typer.Argument(help="The true one, or a recording it is attached to.")],
    tolerance: Annotated[float, typer.Option(help="Metres within which points match.")] = 0.02,
    as_json: AsJson = False,
) -> None:
    """Score a skeleton against the truth: the paper's figures and the stricter ones."""
    scores = score_document(
        read_document(skeleton), read_truth(truth), tolerance_m=tolerance
    ).to_dict()
    if as_json:
        typer.echo(json.dumps(scores, indent=2))
        return
    width = max(map(len, scores))
    for name, value in scores.items():
        shown = f"{value:.4f}" if isinstance(value, float) else str(value)
        typer.echo(f"{name:{width}}  {shown}")
