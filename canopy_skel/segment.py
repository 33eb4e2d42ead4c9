"""Branch instances in a picture: the seam between any segmenter and the method (paper III-A)."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from canopy_skel.frame import UInt16Array, View
from canopy_skel.geometry import BoolArray


@dataclass(frozen=True, kw_only=True, eq=False, slots=True)
class BranchMask:
    """One branch instance: a slender, piecewise straight region of the colour image.

    instance: its number in the view (1, 2, …). mask: (h, w) bool, the region's bounding box, whose
    upper left pixel is (left_px, top_px). confidence: the segmenter's score in (0, 1].
    """

    instance: int
    left_px: int
    top_px: int
    mask: BoolArray
    confidence: float


class Segmenter(Protocol):
    """Finds the branches in a view."""

    def segment(self, view: View) -> Sequence[BranchMask]:
        """Return the branch instances of a view.

        Raises:
            ViewError: the view lacks what this segmenter needs.
        """
        ...


def painted(
    masks: Sequence[BranchMask], size: tuple[int, int]
) -> tuple[UInt16Array, tuple[float, ...]]:
    """Return the (height, width) picture of instances, 0 = none, and their confidences.

    They are numbered 1, 2, … in the order given; where they overlap, the surest is in front.
    """
    picture = np.zeros(size, dtype=np.uint16)
    for place in sorted(range(len(masks)), key=lambda place: masks[place].confidence):
        mask = masks[place]
        height, width = mask.mask.shape
        box = picture[mask.top_px : mask.top_px + height, mask.left_px : mask.left_px + width]
        box[mask.mask] = place + 1
    return picture, tuple(mask.confidence for mask in masks)
