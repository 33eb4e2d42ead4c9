"""Labelled pictures that the command line is given."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from canopy_skel.errors import UsageError
from service.cli.shell import stderr

if TYPE_CHECKING:
    from service.training.user_pictures import UserPicture

Coco = Annotated[Path | None, typer.Option(help="Labels: a COCO instance file (JSON).")]
Images = Annotated[Path | None, typer.Option(help="The folder of the pictures of --coco.")]
LabelMe = Annotated[Path | None, typer.Option(help="Labels: a folder of LabelMe files.")]
Branch = Annotated[
    list[str] | None, typer.Option(help="A category or label that is a branch; repeatable.")
]


@dataclass(frozen=True, kw_only=True, slots=True)
class Labels:
    """Where the labels are, as options said it."""

    coco: Path | None
    images: Path | None
    labelme: Path | None
    branch: Sequence[str]

    @property
    def source(self) -> Path | None:
        """The file or folder of labels, None if none is given."""
        return self.coco or self.labelme

    def pictures(self) -> "list[UserPicture]":
        """Return the labelled pictures; warn on stderr.

        Raises:
            UsageError: not exactly one kind of labels is given, or they are unusable.
        """
        # Imported here: that compiles kernels which no other verb needs.
        from service.training.coco import read_coco
        from service.training.labelme import read_labelme

        if (self.coco is None) is (self.labelme is None):
            raise UsageError("give labels: either --coco FILE with --images DIR, or --labelme DIR")
        if self.labelme is not None:
            pictures, notes = read_labelme(self.labelme, self.branch)
        elif self.coco is None or self.images is None:
            raise UsageError("--coco needs --images, the folder of its pictures")
        else:
            pictures, notes = read_coco(self.coco, self.images, self.branch)
        for note in notes:
            stderr.print(f"warning: {note}", style="yellow", markup=False)
        return pictures
