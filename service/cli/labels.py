"""Labelled pictures that the command line is given."""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

from canopy_skel.errors import UsageError
from service.cli.shell import stderr
from service.training.coco import read_coco
from service.training.labelme import read_labelme
from service.training.user_pictures import UserPicture

Coco = Annotated[Path | None, typer.Option(help="Labels: a COCO instance file (JSON).")]
Images = Annotated[Path | None, typer.Option(help="The folder of the pictures of --coco.")]
LabelMe = Annotated[Path | None, typer.Option(help="Labels: a folder of LabelMe files.")]
Branch = Annotated[
    list[str] | None, typer.Option(help="A category or label that is a branch; repeatable.")
]


def labelled_pictures(
    coco: Path | None, images: Path | None, labelme: Path | None, branch: Sequence[str]
) -> list[UserPicture]:
    """Return the pictures of a COCO file or of a folder of LabelMe files; warn on stderr.

    Raises:
        UsageError: not exactly one of them is given, or it is unusable.
    """
    if (coco is None) is (labelme is None):
        raise UsageError("give labels: either --coco FILE with --images DIR, or --labelme DIR")
    if coco is not None:
        if images is None:
            raise UsageError("--coco needs --images, the folder of its pictures")
        pictures, notes = read_coco(coco, images, branch)
    elif labelme is not None:
        pictures, notes = read_labelme(labelme, branch)
    for note in notes:
        stderr.print(f"warning: {note}", style="yellow", markup=False)
    return pictures
