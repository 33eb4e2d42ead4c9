"""What a view says of places in space."""

import math

import numpy as np
from numpy.typing import NDArray

from canopy_skel.kernels.compiled import kernel

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
UNKNOWN, THROUGH, BACKGROUND, WOOD, LEAF, HIDDEN = range(6)
SHOWS_DENSE, SHOWS_WOOD, SHOWS_BACKGROUND = 1, 2, 4
_NEAREST_M = 0.05


@kernel(
    "void(float64[:,::1], float64[:,::1], UniTuple(float64, 4), int64, float32[:,:,::1],"
    " uint8[:,::1], int64, int64[:,::1])"
)
def count_verdicts(
    points: Floats,
    camera_from_base: Floats,
    camera: tuple[float, float, float, float],
    stride: int,
    range_m: NDArray[np.float32],
    shows: NDArray[np.uint8],
    times: int,
    counts: Ints,
) -> None:
    """Count what a view says of points (N, 3), `times` over, in `counts` (N, 6).

    camera: fx, fy, cx, cy. range_m (h, w, 2): least and largest depth around every pixel of
    `stride`, infinite (negative infinite) without any. shows (h, w): flags SHOWS_*. The margin
    grows with the square of the depth, as stereo noise does.
    """
    height, width = shows.shape
    m = camera_from_base
    for i in range(len(points)):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        depth = x * m[2, 0] + y * m[2, 1] + z * m[2, 2] + m[2, 3]
        u = v = -1.0
        if depth > _NEAREST_M:
            across = x * m[0, 0] + y * m[0, 1] + z * m[0, 2] + m[0, 3]
            down = x * m[1, 0] + y * m[1, 1] + z * m[1, 2] + m[1, 3]
            u = (camera[0] * across / depth + camera[2]) / stride + 0.5
            v = (camera[1] * down / depth + camera[3]) / stride + 0.5
        if not (0.0 <= u < width and 0.0 <= v < height):
            counts[i, UNKNOWN] += times
            continue
        column, row = math.floor(u), math.floor(v)
        nearest, farthest = float(range_m[row, column, 0]), float(range_m[row, column, 1])
        flags, margin = shows[row, column], 0.025 + 0.012 * depth**2
        verdict = UNKNOWN
        if flags & SHOWS_DENSE and depth + margin < nearest < math.inf:
            verdict = THROUGH
        elif flags & SHOWS_BACKGROUND:
            verdict = BACKGROUND
        elif nearest <= depth + margin and farthest >= depth - margin:
            verdict = WOOD if flags & SHOWS_WOOD else LEAF
        elif -math.inf < farthest < depth - margin:
            verdict = HIDDEN
        counts[i, verdict] += times
