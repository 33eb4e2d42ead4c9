"""Which thick wood lies before and behind a point that runs along within it."""

import numpy as np
from numpy.typing import NDArray

from canopy_skel.kernels.compiled import inner, kernel

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

NEAREST = 8
LEAST = 3


@inner("int64(float64, int64, int64, float64[::1], int64[::1])")
def kept(away: float, index: int, count: int, nearest: Floats, which: Ints) -> int:
    """Keep the `NEAREST` in order, of equal ones the first; return how many were given."""
    at = min(count, NEAREST)
    if at == NEAREST:
        if away >= nearest[at - 1]:
            return count + 1
        at -= 1
    while at > 0 and nearest[at - 1] > away:
        nearest[at], which[at] = nearest[at - 1], which[at - 1]
        at -= 1
    nearest[at], which[at] = away, index
    return count + 1


@inner(
    "int64(float64[::1], float64, float64[:,::1], int64, int64, float64[::1], float64[::1],"
    " int64[::1])"
)
def within(
    thin: Floats,
    radius_m: float,
    thick: Floats,
    first: int,
    end: int,
    limits: Floats,
    along_m: Floats,
    found: Ints,
) -> int:
    """Write which of thick[first:end] a thin point runs along within, and how far ahead; how many.

    thin: (6,) point and direction. thick, limits: see `either_side`.
    """
    reach_m, inside, thinner, min_cosine = limits[0], limits[1], limits[2], limits[3]
    px, py, pz, dx, dy, dz = thin[0], thin[1], thin[2], thin[3], thin[4], thin[5]
    count = 0
    for k in range(first, end):
        wx, wy, wz = px - thick[k, 0], py - thick[k, 1], pz - thick[k, 2]
        squared, side_m = wx * wx + wy * wy + wz * wz, inside * thick[k, 6]
        if squared > reach_m * reach_m + side_m * side_m or thick[k, 6] < thinner * radius_m:
            continue
        cosine = dx * thick[k, 3] + dy * thick[k, 4] + dz * thick[k, 5]
        ahead_m = wx * thick[k, 3] + wy * thick[k, 4] + wz * thick[k, 5]
        if abs(cosine) < min_cosine or squared - ahead_m * ahead_m >= side_m * side_m:
            continue
        if abs(ahead_m) <= reach_m:
            along_m[count], found[count] = ahead_m if cosine >= 0.0 else -ahead_m, k
            count += 1
    return count


@kernel(
    "int64[:,:,::1](float64[:,::1], float64[::1], float64[:,::1], int64[:,::1], float64[::1],"
    " float64[::1])"
)
def either_side(
    thin: Floats, radius_m: Floats, thick: Floats, window: Ints, levels_m: Floats, limits: Floats
) -> Ints:
    """Return for each thin point the nearest thick ones behind and before it (T, 2, NEAREST).

    Those of at least the first of `levels_m` (falling) of which there are `LEAST` on both sides;
    filled up with -1, and all -1 where there is no such level.

    thin: (T, 6) points and directions; radius_m: (T,). thick: (K, 7) points, directions, radii.
    window: (T, 2), which of `thick` are asked. limits: farthest along, how many radii across, least
    ratio of the radii, least cosine between the directions.
    """
    result = np.full((len(thin), 2, NEAREST), -1, dtype=np.int64)
    along_m, found = np.empty(len(thick)), np.empty(len(thick), dtype=np.int64)
    nearest, which = np.empty((2, NEAREST)), np.empty((2, NEAREST), dtype=np.int64)
    for i in range(len(thin)):
        first, end = window[i, 0], window[i, 1]
        count = within(thin[i], radius_m[i], thick, first, end, limits, along_m, found)
        for level_m in levels_m:
            if level_m < limits[2] * radius_m[i]:
                break
            behind = before = 0
            for k in range(count):
                if thick[found[k], 6] < level_m:
                    continue
                if along_m[k] > 0.0:
                    behind = kept(along_m[k], found[k], behind, nearest[0], which[0])
                else:
                    before = kept(-along_m[k], found[k], before, nearest[1], which[1])
            if min(behind, before) >= LEAST:
                for k in range(NEAREST):
                    result[i, 0, k] = which[0, k] if k < behind else -1
                    result[i, 1, k] = which[1, k] if k < before else -1
                break
    return result
