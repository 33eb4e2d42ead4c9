"""What a view says of places in space."""

import math

import numpy as np
from numpy.typing import NDArray

from canopy_skel.kernels.compiled import inner, kernel

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Float32s = NDArray[np.float32]
UNKNOWN, THROUGH, BACKGROUND, WOOD, LEAF, HIDDEN = range(6)
"""As in `canopy_skel.evidence`, which must not compile this when it is imported."""
SHOWS_DENSE, SHOWS_WOOD, SHOWS_BACKGROUND = 1, 2, 4
_NEAREST_M = 0.05
_FARTHEST_M = np.finfo(np.float32).max


@kernel(
    "void(float64[:,::1], float64[:,::1], UniTuple(float64, 4), int64, float32[:,:,::1],"
    " uint8[:,::1], int64, int64[:,::1])"
)
def count_verdicts(
    points: Floats,
    camera_from_base: Floats,
    camera: tuple[float, float, float, float],
    stride: int,
    range_m: Float32s,
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


@inner("int64(int64, int64)")
def mirrored(at: int, length: int) -> int:
    """Return the place in [0, length) that one beyond the rims mirrors, the rim not doubled."""
    at = abs(at)
    return max(min(at, 2 * (length - 1) - at), 0)


@kernel(
    "Tuple((float32[:,:,::1], uint8[:,::1]))(Array(float32, 2, 'C', readonly=True), int64, int64,"
    " int64)"
)
def depth_ranges(
    depth_m: Float32s, stride: int, reach: int, min_valid: int
) -> tuple[Float32s, NDArray[np.uint8]]:
    """Return least and largest depth (h, w, 2) within `reach` pixels of every pixel of `stride`.

    Infinite (negative infinite) without any, but finite at the rims of the picture: what may lie
    beyond hides places. Also returns SHOWS_DENSE (h, w) where at least `min_valid` pixels there
    have depth; the picture is mirrored at its rims for that.
    """
    height, width = depth_m.shape
    rows, columns = (height + stride - 1) // stride, (width + stride - 1) // stride
    range_m = np.empty((rows, columns, 2), dtype=np.float32)
    shows = np.zeros((rows, columns), dtype=np.uint8)
    low, high = np.empty(width, dtype=np.float32), np.empty(width, dtype=np.float32)
    valid, none = np.empty(width, dtype=np.int32), np.float32(math.inf)
    for row in range(rows):
        top, bottom = row * stride - reach, row * stride + reach
        nothing = none if top >= 0 and bottom < height else _FARTHEST_M
        for u in range(width):
            low[u], high[u], valid[u] = nothing, -nothing, 0
        for at in range(top, bottom + 1):
            v = mirrored(at, height)
            for u in range(width):
                z = depth_m[v, u]
                has = abs(z) < none
                low[u] = min(low[u], z if has else none)
                high[u] = max(high[u], z if has else -none)
                valid[u] += has
        for column in range(columns):
            left, right = column * stride - reach, column * stride + reach
            least = none if left >= 0 and right < width else _FARTHEST_M
            largest, count = -least, 0
            for at in range(left, right + 1):
                u = mirrored(at, width)
                least, largest = min(least, low[u]), max(largest, high[u])
                count += valid[u]
            range_m[row, column, 0], range_m[row, column, 1] = least, largest
            shows[row, column] = SHOWS_DENSE if count >= min_valid else 0
    return range_m, shows
