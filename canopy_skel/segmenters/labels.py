"""Labelled pictures: what any learned segmenter is trained and judged on, whoever labelled them."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from canopy_skel.frame import UInt8Array, UInt16Array
from canopy_skel.geometry import BoolArray, FloatArray


@dataclass(frozen=True, kw_only=True, eq=False, slots=True)
class LabelledImage:
    """One picture with its branch instances.

    color_rgb: (H, W, 3) uint8. instances: (H, W) uint16, 0 = none, i = instance i. lines: per
    instance the (N, 3) u, v and radius in pixels along its middle, N >= 2; the line may run on
    where something hides the wood. ignore: (H, W), wood nobody need find and nobody may be blamed
    for.
    """

    color_rgb: UInt8Array
    instances: UInt16Array
    lines: tuple[FloatArray, ...]
    ignore: BoolArray


class LabelledImages(Protocol):
    """A data set: pictures by number, the same picture each time."""

    def __len__(self) -> int:
        """Return how many pictures there are."""
        ...

    def __getitem__(self, index: int, /) -> LabelledImage:
        """Return one picture.

        Raises:
            IndexError: there is no such picture.
        """
        ...


def line_of_mask(mask: BoolArray, bins: int = 8) -> FloatArray:
    """Return the (N, 3) middle line u, v, radius of a slender mask, from its principal axis.

    mask: (h, w) with at least two pixels. The radius is half the mean width of each stretch.
    """
    v, u = np.nonzero(mask)
    points = np.stack([u, v], axis=1).astype(np.float64)
    centre = points.mean(axis=0)
    axes = np.linalg.eigh(np.cov((points - centre).T))[1].T[::-1]
    along, across = (points - centre) @ axes[0], (points - centre) @ axes[1]
    low, high = float(along.min()), float(along.max())
    count = int(np.clip((high - low) / 4, 1, bins))
    place = np.minimum(((along - low) / (high - low + 1e-9) * count).astype(np.int64), count - 1)
    pixels = np.bincount(place, minlength=count)
    used = np.flatnonzero(pixels)
    offset = np.bincount(place, across, count)[used] / pixels[used]
    stations = low + (used + 0.5) * (high - low) / count
    radius = np.maximum(0.5 * pixels[used] * count / max(high - low + 1, 1.0), 0.5)
    middle = centre + stations[:, None] * axes[0] + offset[:, None] * axes[1]
    first = middle[0] + (low - stations[0]) * axes[0]
    last = middle[-1] + (high - stations[-1]) * axes[0]
    line = np.concatenate([first[None], middle, last[None]])
    return np.column_stack([line, np.concatenate([radius[:1], radius, radius[-1:]])])


def without_small(
    image: LabelledImage, *, pixels: int = 150, width_px: float = 2.5, length_px: float = 40.0
) -> LabelledImage:
    """Return the picture with instances too small to be asked of anybody turned into `ignore`.

    width_px: mean width, pixels over length. The limits are those of what a recording counts as
    detectable (5 cm of wood at 1.1 m with an OAK-D).
    """
    number = np.zeros(len(image.lines) + 1, dtype=np.uint16)
    area = np.bincount(image.instances.ravel(), minlength=len(number))
    kept = []
    for k, line in enumerate(image.lines, start=1):
        length = float(np.linalg.norm(np.diff(line[:, :2], axis=0), axis=1).sum())
        if area[k] >= pixels and length >= length_px and area[k] >= width_px * length:
            kept.append(line)
            number[k] = len(kept)
    instances = number[image.instances]
    return LabelledImage(
        color_rgb=image.color_rgb,
        instances=instances,
        lines=tuple(kept),
        ignore=image.ignore | ((image.instances > 0) & (instances == 0)),
    )


def labelled_image(
    color_rgb: UInt8Array, masks: Sequence[BoolArray], ignore: BoolArray
) -> LabelledImage:
    """Return a labelled picture from (H, W) masks alone; a later mask wins where two overlap."""
    instances = np.zeros(ignore.shape, dtype=np.uint16)
    for number, mask in enumerate(masks, start=1):
        instances[mask] = number
    return LabelledImage(
        color_rgb=color_rgb,
        instances=instances,
        lines=tuple(line_of_mask(mask) for mask in masks),
        ignore=ignore,
    )
