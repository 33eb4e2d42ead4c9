"""Branch instances in a picture: the seam between any segmenter and the method (paper III-A)."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from canopy_skel.errors import ViewError
from canopy_skel.frame import UInt16Array, View
from canopy_skel.geometry import BoolArray


@dataclass(frozen=True, kw_only=True, eq=False, slots=True)
class BranchMask:
    """One branch instance: a slender, piecewise straight region of the colour image.

    instance: its number in the view (1, 2, …). mask: (h, w) bool, the region's bounding box, whose
    upper left pixel is (left_px, top_px). confidence: the segmenter's score in (0, 1]. radius_px:
    half its width as the segmenter measured it by more than the mask, None if it did not.
    """

    instance: int
    left_px: int
    top_px: int
    mask: BoolArray
    confidence: float
    radius_px: float | None = None


class Segmenter(Protocol):
    """Finds the branches in a view."""

    def segment(self, view: View) -> Sequence[BranchMask]:
        """Return the branch instances of a view.

        Raises:
            ViewError: the view lacks what this segmenter needs.
        """
        ...


def require_masks(view: View, masks: Sequence[BranchMask]) -> None:
    """Check that masks of a view are what `BranchMask` says: anybody may write a segmenter.

    Raises:
        ViewError: one is not.
    """
    height, width = view.color_rgb.shape[:2]
    for mask in masks:
        name = f"view {view.index}: the mask of instance {mask.instance}"
        if mask.mask.dtype != np.bool_ or mask.mask.ndim != 2:
            raise ViewError(
                f"{name} is {mask.mask.ndim}-D {mask.mask.dtype}; its segmenter must give 2-D bool"
            )
        right, bottom = mask.left_px + mask.mask.shape[1], mask.top_px + mask.mask.shape[0]
        if min(mask.left_px, mask.top_px) < 0 or right > width or bottom > height:
            raise ViewError(
                f"{name} covers columns {mask.left_px} to {right} and rows {mask.top_px} to"
                f" {bottom} of a picture of {width}x{height}; its segmenter must cut it off at the"
                " border"
            )
        if not 0.0 <= mask.confidence <= 1.0:
            raise ViewError(
                f"{name} has a confidence of {mask.confidence}; its segmenter must give one from 0"
                " to 1"
            )
        if mask.radius_px is not None and not 0.0 < mask.radius_px < np.inf:
            raise ViewError(
                f"{name} has a radius of {mask.radius_px} px; its segmenter must give one above 0,"
                " or None"
            )


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
