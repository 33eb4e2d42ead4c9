"""Labelled pictures on disk, ready for crops to be cut from them without decoding anything."""

import os
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from canopy_skel.errors import UsageError
from canopy_skel.frame import UInt8Array
from canopy_skel.segmenters.labels import LabelledImage
from canopy_skel.segmenters.unet.targets import TARGETS, targets_of


class StoredImages:
    """A folder of labelled pictures: per picture its colour, its target maps and its labels."""

    def __init__(self, folder: Path) -> None:
        """Take the pictures that are whole in `folder`, in the order of their names."""
        self._folder = folder
        self.names = sorted(path.name.split(".")[0] for path in folder.glob("*.labels.npz"))

    def __len__(self) -> int:
        """Return how many pictures there are."""
        return len(self.names)

    def __getitem__(self, index: int, /) -> LabelledImage:
        """Return one picture with its labels."""
        with np.load(self._folder / f"{self.names[index]}.labels.npz") as file:
            ends = np.cumsum(file["counts"])[:-1]
            return LabelledImage(
                color_rgb=np.array(self.color(index)),
                instances=file["instances"],
                lines=tuple(np.split(file["lines"], ends)) if len(file["counts"]) else (),
                ignore=file["ignore"],
            )

    def color(self, index: int) -> UInt8Array:
        """Return the (H, W, 3) picture, mapped from disk."""
        color: UInt8Array = np.load(self._folder / f"{self.names[index]}.color.npy", mmap_mode="r")
        return color

    def maps(self, index: int) -> UInt8Array:
        """Return the (H / 2, W / 2, 5) target maps, mapped from disk.

        Raises:
            UsageError: another version stored them, for a network with other maps.
        """
        maps: UInt8Array = np.load(self._folder / f"{self.names[index]}.maps.npy", mmap_mode="r")
        if maps.shape[2:] != (TARGETS,):
            raise UsageError(
                f"{self._folder}: holds pictures that another version has stored; give another"
                " folder, or delete this one to have them drawn anew"
            )
        return maps


def store(folder: Path, images: Iterable[tuple[str, LabelledImage]]) -> int:
    """Write named pictures to a folder; return how many. Labels come last, so whole is whole.

    Raises:
        UsageError: the folder cannot be written.
    """
    count = 0
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for name, image in images:
            _write(folder / name, image)
            count += 1
    except OSError as error:
        raise UsageError(f"{folder}: cannot be written ({error.strerror})") from error
    return count


def _write(stem: Path, image: LabelledImage) -> None:
    np.save(f"{stem}.color.npy", image.color_rgb)
    np.save(f"{stem}.maps.npy", targets_of(image))
    counts = np.array([len(line) for line in image.lines], dtype=np.int64)
    lines = np.concatenate([np.zeros((0, 3)), *image.lines])
    part = Path(f"{stem}.part.npz")
    np.savez_compressed(
        part, instances=image.instances, ignore=image.ignore, lines=lines, counts=counts
    )
    os.replace(part, f"{stem}.labels.npz")
