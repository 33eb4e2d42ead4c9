"""Which thick wood lies before and behind a point that runs along within it."""

import math

import numpy as np
from numpy.typing import NDArray

from canopy_skel.kernels.compiled import inner, kernel

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

BLOCK = 16
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
    "int64(float64[::1], float64, float64[:,::1], int64, int64, float64[::1], int64, float64[::1],"
    " int64[::1])"
)
def within(
    thin: Floats,
    radius_m: float,
    thick: Floats,
    first: int,
    end: int,
    limits: Floats,
    count: int,
    along_m: Floats,
    found: Ints,
) -> int:
    """Add to `count` found ones which of thick[first:end] a thin point runs along within.

    Also writes how far ahead of them it is; returns how many are found now. thin: (6,) point and
    direction. thick, limits: see `either_side`.
    """
    reach_m, inside, thinner, min_cosine = limits[0], limits[1], limits[2], limits[3]
    px, py, pz, dx, dy, dz = thin[0], thin[1], thin[2], thin[3], thin[4], thin[5]
    for k in range(first, end):
        cosine = dx * thick[k, 3] + dy * thick[k, 4] + dz * thick[k, 5]
        if abs(cosine) < min_cosine:
            continue
        wx, wy, wz = px - thick[k, 0], py - thick[k, 1], pz - thick[k, 2]
        squared, side_m = wx * wx + wy * wy + wz * wz, inside * thick[k, 6]
        ahead_m = wx * thick[k, 3] + wy * thick[k, 4] + wz * thick[k, 5]
        if squared - ahead_m * ahead_m >= side_m * side_m or thick[k, 6] < thinner * radius_m:
            continue
        if abs(ahead_m) <= reach_m:
            along_m[count], found[count] = ahead_m if cosine >= 0.0 else -ahead_m, k
            count += 1
    return count


@inner("float64[:,::1](float64[:,::1], float64)")
def boxes_around(thick: Floats, inside: float) -> Floats:
    """Return least and largest x, y and z of the wood of every `BLOCK` of `thick` (B, 6)."""
    boxes = np.empty(((len(thick) + BLOCK - 1) // BLOCK, 6))
    for b in range(len(boxes)):
        for axis in range(3):
            low, high = math.inf, -math.inf
            for k in range(b * BLOCK, min((b + 1) * BLOCK, len(thick))):
                low = min(low, thick[k, axis] - inside * thick[k, 6])
                high = max(high, thick[k, axis] + inside * thick[k, 6])
            boxes[b, axis], boxes[b, 3 + axis] = low, high
    return boxes


@inner("boolean(float64[::1], float64[::1], float64)")
def reaches(thin: Floats, box: Floats, reach_m: float) -> bool:
    """Say whether a point lies within reach of a box."""
    squared = 0.0
    for axis in range(3):
        beside = max(box[axis] - thin[axis], thin[axis] - box[3 + axis], 0.0)
        squared += beside * beside
    return bool(squared <= reach_m * reach_m)


@kernel("int64[:,:,::1](float64[:,::1], float64[::1], float64[:,::1], float64[::1], float64[::1])")
def either_side(
    thin: Floats, radius_m: Floats, thick: Floats, levels_m: Floats, limits: Floats
) -> Ints:
    """Return for each thin point the nearest thick ones behind and before it (T, 2, NEAREST).

    Those of at least the first of `levels_m` (falling) of which there are `LEAST` on both sides;
    filled up with -1, and all -1 where there is no such level.

    thin: (T, 6) points and directions; radius_m: (T,). thick: (K, 7) points, directions, radii; it
    is quickest where these that follow one another lie side by side. limits: farthest along, how
    many radii across, least ratio of the radii, least cosine between the directions.
    """
    result = np.full((len(thin), 2, NEAREST), -1, dtype=np.int64)
    along_m, found = np.empty(len(thick)), np.empty(len(thick), dtype=np.int64)
    nearest, which = np.empty((2, NEAREST)), np.empty((2, NEAREST), dtype=np.int64)
    boxes = boxes_around(thick, limits[1])
    for i in range(len(thin)):
        count = 0
        for b in range(len(boxes)):
            if reaches(thin[i], boxes[b], limits[0]):
                first, end = b * BLOCK, min((b + 1) * BLOCK, len(thick))
                count = within(
                    thin[i], radius_m[i], thick, first, end, limits, count, along_m, found
                )
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
