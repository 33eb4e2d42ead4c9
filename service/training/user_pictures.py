"""A user's labelled pictures, from whatever tool: read when asked for, told apart by scan."""

import re
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path

import numpy as np

from canopy_skel.errors import UsageError
from canopy_skel.segmenters.labels import LabelledImage
from service.picture_files import decode_picture, read_picture
from service.training.shapes import (
    LEAST_PIXELS,
    Region,
    Shape,
    connected,
    is_slender,
    middle_lines,
    straight,
)

_FRAME_NUMBER = re.compile(r"[-_. ]*(?:frame|view|img|image)?[-_. ]*\d+$", re.IGNORECASE)


@dataclass(frozen=True, kw_only=True, eq=False, slots=True)
class UserPicture:
    """One labelled picture that has not been read yet.

    path: of the picture, or of the file it is embedded in. data: the embedded picture. size:
    (height, width) that the labels say it has. scan: which scan it belongs to.
    """

    path: Path
    size: tuple[int, int]
    scan: str
    branches: tuple[Shape, ...]
    ignored: tuple[Shape, ...]
    data: bytes | None = None


@dataclass(frozen=True, kw_only=True, eq=False, slots=True)
class Labelled:
    """A picture with its labels and what was remarkable: names of shapes bent, or not slender."""

    image: LabelledImage
    bent: tuple[str, ...]
    stout: tuple[str, ...]


class UserPictures:
    """A data set (`LabelledImages`) of a user's pictures."""

    def __init__(self, pictures: Sequence[UserPicture]) -> None:
        self.pictures = tuple(pictures)

    def __len__(self) -> int:
        """Return how many pictures there are."""
        return len(self.pictures)

    def __getitem__(self, index: int, /) -> LabelledImage:
        """Return one picture; see `labelled`."""
        return labelled(self.pictures[index]).image


def labelled(picture: UserPicture) -> Labelled:
    """Read a picture and draw its labels.

    Every connected, straight piece of a shape is an instance; where shapes overlap, the smaller
    one is in front; parts too small to have a direction are ignored.

    Raises:
        UsageError: the picture cannot be read or has another size, or a shape does not fit it.
    """
    if picture.data is None:
        color = read_picture(picture.path)
    else:
        color = decode_picture(picture.data, f"{picture.path}: the embedded picture")
    if color.shape[:2] != picture.size:
        raise UsageError(
            f"{picture.path}: is {color.shape[1]}x{color.shape[0]} but was labelled as"
            f" {picture.size[1]}x{picture.size[0]}; give the very pictures that were labelled"
        )
    ignore = np.zeros(picture.size, dtype=np.bool_)
    for shape in picture.ignored:
        region = _region(shape, picture)
        ignore[region.box] |= region.mask
    pieces: list[Region] = []
    bent, stout = [], []
    for shape in picture.branches:
        parts, small = _parts(_region(shape, picture))
        own = [piece for part in parts for piece in straight(part)]
        if len(own) > len(parts):
            bent.append(shape.name)
        if any(not is_slender(part) for part in own):
            stout.append(shape.name)
        pieces += own
        for part in small:
            ignore[part.box] |= part.mask
    instances, pieces = _layered(pieces, picture.size)
    image = LabelledImage(
        color_rgb=color, instances=instances, lines=middle_lines(pieces), ignore=ignore
    )
    return Labelled(image=image, bent=tuple(bent), stout=tuple(stout))


def _region(shape: Shape, picture: UserPicture) -> Region:
    try:
        return shape.region(picture.size)
    except ValueError as error:
        raise UsageError(
            f"{picture.path}: {shape.name} {error} ({picture.size[1]}x{picture.size[0]}); correct"
            " or remove it"
        ) from error


def _parts(region: Region) -> tuple[list[Region], list[Region]]:
    """Return the connected parts that are large enough, and those that are not."""
    parts = connected(region)
    large = [part for part in parts if part.mask.sum() >= LEAST_PIXELS]
    return large, [part for part in parts if part.mask.sum() < LEAST_PIXELS]


def _layered(pieces: list[Region], size: tuple[int, int]) -> tuple[np.ndarray, list[Region]]:
    """Number the pieces from large to small, and return what is left to see of each."""
    ordered = sorted(pieces, key=lambda piece: -int(piece.mask.sum()))
    layers = np.zeros(size, dtype=np.int64)
    for number, piece in enumerate(ordered, start=1):
        layers[piece.box][piece.mask] = number
    instances = np.zeros(size, dtype=np.uint16)
    left: list[Region] = []
    for number, piece in enumerate(ordered, start=1):
        seen = layers[piece.box] == number
        if seen.sum() >= LEAST_PIXELS:
            left.append(Region(left=piece.left, top=piece.top, mask=seen))
            instances[piece.box][seen] = len(left)
    return instances, left


def scan_of(file_name: str, scan_id: object = None) -> str:
    """Return which scan a picture is of: as it says, else its folder, else its name's beginning.

    `north/row3_tree2_0007.jpg` is of `north/row3_tree2`.
    """
    if isinstance(scan_id, str | int) and scan_id != "":
        return str(scan_id)
    path = Path(file_name)
    stem = _FRAME_NUMBER.sub("", path.stem)
    return (path.parent / stem).as_posix() if stem else path.parent.as_posix()


def split(
    pictures: Sequence[UserPicture], share: float = 0.2
) -> tuple[list[UserPicture], list[UserPicture]]:
    """Return pictures to train on and pictures to validate with, no scan in both.

    Scans are taken in an order that depends on their names alone, until `share` of the pictures
    are for validation. Of a single scan, nothing is: its pictures are too alike to judge by.
    """
    scans: defaultdict[str, list[UserPicture]] = defaultdict(list)
    for picture in pictures:
        scans[picture.scan].append(picture)
    order = sorted(scans, key=lambda scan: sha256(scan.encode()).hexdigest())
    held: list[str] = []
    for scan in order[:-1]:
        if sum(len(scans[one]) for one in held) >= share * len(pictures):
            break
        held.append(scan)
    validate = [picture for picture in pictures if picture.scan in held]
    return [picture for picture in pictures if picture.scan not in held], validate
