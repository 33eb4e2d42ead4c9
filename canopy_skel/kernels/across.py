"""Move a point towards a curve, but not along it."""

import math

import numpy as np
from numpy.typing import NDArray

from canopy_skel.kernels.compiled import inner

Floats = NDArray[np.float64]
Triple = tuple[float, float, float]


@inner("boolean(UniTuple(float64, 3), UniTuple(float64, 3), float64, float64[::1], float64[::1])")
def draw(
    offset: Triple,
    heading: Triple,
    total: float,
    point: Floats,
    direction: Floats,
) -> bool:
    """Move a point by the mean offset, across the mean heading, which becomes its direction.

    offset, heading: weighted sums; total: of the weights. False, and nothing is done, where there
    are none or the headings cancel out.
    """
    ex, ey, ez = heading
    norm = math.sqrt(ex * ex + ey * ey + ez * ez)
    if total <= 0.0 or norm <= 1e-9:
        return False
    ex, ey, ez = ex / norm, ey / norm, ez / norm
    ox, oy, oz = offset[0] / total, offset[1] / total, offset[2] / total
    along = ox * ex + oy * ey + oz * ez
    point[0], point[1] = point[0] + ox - along * ex, point[1] + oy - along * ey
    point[2] = point[2] + oz - along * ez
    direction[0], direction[1], direction[2] = ex, ey, ez
    return True
