"""What each view says about a place in space: looked through, wood, leaves, or hidden."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from canopy_skel.frame import Float32Array, Intrinsics, View
from canopy_skel.geometry import BoolArray, FloatArray, IntArray, invert, transform_points
from canopy_skel.pieces import depth_of

UNKNOWN, THROUGH, BACKGROUND, WOOD, LEAF, HIDDEN = range(6)
STRIDE = 2
_WINDOW = 5
_MIN_VALID = 0.6
_BACKGROUND_PX = 3000


@dataclass(frozen=True, kw_only=True, eq=False, slots=True)
class ViewEvidence:
    """One view, made ready to be asked about points; pictures at every second pixel.

    nearest_m, farthest_m: least and largest depth in a window of 5 x 5 pixels, infinite (negative
    infinite) without any. dense: enough of the window has depth. wood: it shows wood. background:
    it lies in a large region without return.
    """

    intrinsics: Intrinsics
    camera_from_base: FloatArray
    nearest_m: Float32Array
    farthest_m: Float32Array
    dense: BoolArray
    wood: BoolArray
    background: BoolArray

    def classify(self, points_in_base: FloatArray) -> NDArray[np.int8]:
        """Return what this view says of each point (N,): one of the codes above.

        The margin grows with the square of the depth, as stereo noise does.
        """
        verdict = np.zeros(len(points_in_base), dtype=np.int8)
        in_camera = transform_points(self.camera_from_base, points_in_base)
        ahead = np.flatnonzero(in_camera[:, 2] > 0.05)
        pixel = np.floor(self.intrinsics.project(in_camera[ahead]) / STRIDE + 0.5).astype(np.int64)
        height, width = self.nearest_m.shape
        inside = np.all((pixel >= 0) & (pixel < [width, height]), axis=1)
        ahead, (u, v) = ahead[inside], pixel[inside].T
        z = in_camera[ahead, 2]
        margin = 0.025 + 0.012 * z**2
        nearest, farthest = self.nearest_m[v, u], self.farthest_m[v, u]
        verdict[ahead] = np.select(
            [
                (nearest > z + margin) & np.isfinite(nearest) & self.dense[v, u],
                self.background[v, u],
                (nearest <= z + margin) & (farthest >= z - margin),
                np.isfinite(farthest) & (farthest < z - margin),
            ],
            [THROUGH, BACKGROUND, np.where(self.wood[v, u], WOOD, LEAF), HIDDEN],
            UNKNOWN,
        )
        return verdict


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
    return ViewEvidence(
        intrinsics=view.intrinsics,
        camera_from_base=invert(view.base_from_camera),
        nearest_m=nearest[every].astype(np.float32),
        farthest_m=farthest[every].astype(np.float32),
        dense=(share > _MIN_VALID)[every].copy(),
        wood=around[every] > 0,
        background=_background(~valid)[every].copy(),
    )


def counted(verdicts: NDArray[np.int8]) -> IntArray:
    """Turn the verdicts (N,) of one view into counts (N, 6) by code."""
    return np.eye(6, dtype=np.int64)[verdicts]


def count_evidence(points_in_base: FloatArray, views: Sequence[ViewEvidence]) -> IntArray:
    """Return how many views say what (N, 6) of each point (N, 3)."""
    counts = np.zeros((len(points_in_base), 6), dtype=np.int64)
    for view in views:
        counts += counted(view.classify(points_in_base))
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
