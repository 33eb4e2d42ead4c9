"""What each view says about a place in space: looked through, wood, leaves, or hidden."""

from collections.abc import Iterable
from dataclasses import dataclass

import cv2
import numpy as np

from canopy_skel.frame import Float32Array, Intrinsics, UInt8Array, View
from canopy_skel.geometry import BoolArray, FloatArray, IntArray, invert
from canopy_skel.kernels.verdicts import (
    BACKGROUND,
    SHOWS_BACKGROUND,
    SHOWS_DENSE,
    SHOWS_WOOD,
    THROUGH,
    count_verdicts,
)
from canopy_skel.pieces import depth_of

STRIDE = 2
_WINDOW = 5
_MIN_VALID = 0.6
_BACKGROUND_PX = 3000


@dataclass(frozen=True, kw_only=True, eq=False, slots=True)
class ViewEvidence:
    """One view, made ready to be asked about points; pictures at every second pixel.

    range_m (h, w, 2): least and largest depth in a window of 5 x 5 pixels, infinite (negative
    infinite) without any. shows (h, w), flags: enough of the window has depth; it shows wood; it
    lies in a large region without return.
    """

    intrinsics: Intrinsics
    camera_from_base: FloatArray
    range_m: Float32Array
    shows: UInt8Array

    def count(self, points_in_base: FloatArray, counts: IntArray, times: int = 1) -> None:
        """Add what this view says of points (N, 3), `times` over, to `counts` (N, 6)."""
        camera = self.intrinsics
        count_verdicts(
            np.ascontiguousarray(points_in_base),
            self.camera_from_base,
            (camera.fx_px, camera.fy_px, camera.cx_px, camera.cy_px),
            STRIDE,
            self.range_m,
            self.shows,
            times,
            counts,
        )


def evidence_of(view: View, wood: BoolArray) -> ViewEvidence:
    """Make a view ready to be asked; `wood` (H, W): a mask or a fragment covers the pixel."""
    depth_m = depth_of(view)
    valid = np.isfinite(depth_m)
    window = np.ones((_WINDOW, _WINDOW), dtype=np.uint8)
    infinite = np.float32(np.inf)
    # Outside the picture nothing may win: the default border of these filters never does.
    nearest = cv2.erode(np.where(valid, depth_m, infinite), window)
    farthest = cv2.dilate(np.where(valid, depth_m, -infinite), window)
    share = cv2.blur(valid.astype(np.float32), (_WINDOW, _WINDOW))
    around = cv2.dilate(wood.astype(np.uint8), np.ones((3, 3), dtype=np.uint8))
    every = (slice(None, None, STRIDE), slice(None, None, STRIDE))
    shows = SHOWS_DENSE * (share[every] > _MIN_VALID).astype(np.uint8)
    shows |= SHOWS_WOOD * (around[every] > 0).astype(np.uint8)
    shows |= SHOWS_BACKGROUND * _background(~valid)[every].astype(np.uint8)
    return ViewEvidence(
        intrinsics=view.intrinsics,
        camera_from_base=invert(view.base_from_camera),
        range_m=np.stack([nearest[every], farthest[every]], axis=2),
        shows=shows,
    )


def count_evidence(points_in_base: FloatArray, views: Iterable[ViewEvidence]) -> IntArray:
    """Return how many views say what (N, 6) of each point (N, 3)."""
    counts = np.zeros((len(points_in_base), 6), dtype=np.int64)
    for view in views:
        view.count(points_in_base, counts)
    return counts


def is_empty(counts: IntArray) -> BoolArray:
    """Say which points (N,) nothing can be at: seen through, or sky behind them in two views.

    One view with sky behind is not enough: thin wood often has no return.
    """
    return np.asarray((counts[:, THROUGH] >= 1) | (counts[:, BACKGROUND] >= 2))


def _background(missing: BoolArray) -> BoolArray:
    """Return the large regions (H, W) without return, two pixels off their rims."""
    _, labels, stats, _ = cv2.connectedComponentsWithStats(missing.astype(np.uint8))
    large = stats[:, cv2.CC_STAT_AREA] > _BACKGROUND_PX
    large[0] = False
    region = large[labels].astype(np.uint8)
    return np.asarray(cv2.erode(region, np.ones((5, 5), np.uint8), borderValue=0) > 0)
