"""Is a picture good enough to keep? Checked at the waypoint, while a retake costs a second."""

from dataclasses import dataclass

import cv2
import numpy as np

from canopy_skel.geometry import FloatArray
from drivers.kinematics import relative_turn, rotation_vector
from drivers.protocols import CameraImage


@dataclass(frozen=True, kw_only=True, slots=True)
class QualityLimits:
    """What a picture must be at least.

    min_sharpness: variance of the Laplacian of the grey picture. max_clipped: share of black or
    white pixels. min_depth_fill: share of pixels with depth, where there is a depth image.
    max_shift_m, max_turn_rad: how far the flange may move during the exposure.
    """

    min_sharpness: float = 10.0
    max_clipped: float = 0.6
    min_depth_fill: float = 0.005
    max_shift_m: float = 0.0005
    max_turn_rad: float = 0.001


def flaws(image: CameraImage, limits: QualityLimits) -> list[str]:
    """Return why a picture should be taken again; nothing if it is good."""
    grey = cv2.cvtColor(image.color_rgb, cv2.COLOR_RGB2GRAY)
    found = []
    sharpness = float(cv2.Laplacian(grey, cv2.CV_64F).var())
    if sharpness < limits.min_sharpness:
        found.append(f"blurred (sharpness {sharpness:.1f} < {limits.min_sharpness})")
    clipped = float(np.mean((grey <= 2) | (grey >= 253)))
    if clipped > limits.max_clipped:
        found.append(f"badly exposed ({clipped:.0%} of the pixels black or white)")
    if image.depth_m is not None:
        fill = float(np.isfinite(image.depth_m).mean())
        if fill < limits.min_depth_fill:
            found.append(f"hardly any depth ({fill:.1%} of the pixels)")
    return found


def moved(before: FloatArray, after: FloatArray, limits: QualityLimits) -> str | None:
    """Say how far the flange moved between two poses (4, 4), if that was too far."""
    shift_m = float(np.linalg.norm(after[:3, 3] - before[:3, 3]))
    turn_rad = float(np.linalg.norm(rotation_vector(relative_turn(before, after))))
    if shift_m <= limits.max_shift_m and turn_rad <= limits.max_turn_rad:
        return None
    return f"the arm moved {1e3 * shift_m:.2f} mm, {1e3 * turn_rad:.2f} mrad during the exposure"
