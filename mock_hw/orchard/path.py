"""The camera of the simulated rig and the paths it follows."""

import numpy as np
from numpy.typing import ArrayLike

from canopy_skel.errors import UsageError
from canopy_skel.frame import Intrinsics
from canopy_skel.geometry import FloatArray, transform_from
from mock_hw.orchard.tree import TRUNK_X_M

BASELINE_M = 0.075
"""Between left and right eye (OAK-D)."""

OAK_D = Intrinsics(fx_px=882.5, fy_px=882.5, cx_px=640.0, cy_px=400.0, width_px=1280, height_px=800)

TOOL_FROM_CAMERA = transform_from(
    np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]), [-0.045, 0.0, 0.060]
)
"""The true hand-eye transform: the camera hangs under the flange, a quarter turn about its axis."""


def look_at(eye_m: ArrayLike, target_m: ArrayLike) -> FloatArray:
    """Return `base_from_camera` (4, 4) of an upright camera at `eye_m` looking at `target_m`."""
    eye = np.asarray(eye_m, dtype=np.float64)
    forward = np.asarray(target_m, dtype=np.float64) - eye
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    return transform_from(np.stack([right, np.cross(forward, right), forward], axis=1), eye)


def camera_path(views: int) -> list[FloatArray]:
    """Return the `base_from_camera` poses of a scan with 10 or 70 views, serpentine.

    Raises:
        UsageError: there is no path of so many views.
    """
    if views == 10:
        return _serpentine(np.array([-0.30, 0.42]), np.linspace(-0.52, 0.52, 5), dome=0.0)
    if views == 70:
        return _serpentine(np.linspace(-0.54, 0.66, 7), np.linspace(-0.60, 0.60, 10), dome=0.2)
    raise UsageError(f"no camera path with {views} views; choose 10 or 70")


def _serpentine(heights: FloatArray, columns: FloatArray, *, dome: float) -> list[FloatArray]:
    """Return poses row by row; `dome` draws high and low rows back to where a UR5 reaches."""
    middle = heights.mean()
    poses = []
    for row, z in enumerate(heights):
        for y in columns if row % 2 == 0 else columns[::-1]:
            target = [TRUNK_X_M, 0.35 * y, 0.10 + 0.55 * z]
            x = 0.42 - 0.25 * y**2 - dome * (z - middle) ** 2
            poses.append(look_at([x, y, z], target))
    return poses
