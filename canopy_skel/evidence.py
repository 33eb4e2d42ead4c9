"""What each view says about a place in space: looked through, wood, leaves, or hidden."""

from collections.abc import Iterable
from dataclasses import dataclass

import cv2
import numpy as np

from canopy_skel.components import painted, runs_of
from canopy_skel.frame import Float32Array, Intrinsics, UInt8Array, View
from canopy_skel.geometry import BoolArray, FloatArray, IntArray, invert
from canopy_skel.kernels import verdicts
from canopy_skel.pieces import depth_of

UNKNOWN, THROUGH, BACKGROUND, WOOD, LEAF, HIDDEN = range(6)
STRIDE = 2
_WINDOW = 5
_MIN_VALID_PX = 16
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
        verdicts.count_verdicts(
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
    depth_m = np.ascontiguousarray(depth_of(view), dtype=np.float32)
    range_m, shows = verdicts.depth_ranges(depth_m, STRIDE, _WINDOW // 2, _MIN_VALID_PX)
    around = np.asarray(cv2.dilate(wood.view(np.uint8), np.ones((3, 3), np.uint8)), dtype=np.uint8)
    every = (slice(None, None, STRIDE), slice(None, None, STRIDE))
    shows |= verdicts.SHOWS_WOOD * around[every]
    shows |= verdicts.SHOWS_BACKGROUND * _background(~np.isfinite(depth_m))[every]
    return ViewEvidence(
        intrinsics=view.intrinsics,
        camera_from_base=invert(view.base_from_camera),
        range_m=range_m,
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


def _background(missing: BoolArray) -> UInt8Array:
    """Return 1 in the large regions (H, W) without return, two pixels off their rims, else 0."""
    runs = runs_of(missing)
    region = painted(runs, runs.area > _BACKGROUND_PX, missing.shape).view(np.uint8)
    return np.asarray(cv2.erode(region, np.ones((5, 5), np.uint8), borderValue=0), dtype=np.uint8)
