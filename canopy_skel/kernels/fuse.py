"""Draw points of many views onto the curve they lie on, and sum up what stands behind each."""

import math

import numpy as np
from numpy.typing import NDArray

from canopy_skel.kernels.across import draw
from canopy_skel.kernels.cells import cell_key, first_at
from canopy_skel.kernels.compiled import inner, kernel

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
SUPPORT = 6
"""Columns: total weight, radius, mean p, largest p, views, share of weight from instances."""


@kernel("int64[::1](float64[:,::1], float64)")
def cell_keys(points: Floats, cell_m: float) -> Ints:
    """Return the number of the cell that each of (N, 3) points lies in."""
    keys = np.zeros(len(points), dtype=np.int64)
    for i in range(len(points)):
        x, y = math.floor(points[i, 0] / cell_m), math.floor(points[i, 1] / cell_m)
        keys[i] = cell_key(x, y, math.floor(points[i, 2] / cell_m))
    return keys


@inner("int64(float64[:,::1], int64, float64, float64[:,::1], int64[::1], float64, int64[::1])")
def near(
    points: Floats, i: int, reach: float, references: Floats, keys: Ints, cell_m: float, found: Ints
) -> int:
    """Write which references (R, 3), sorted by `keys` of their cells, point i reaches; how many."""
    px, py, pz = points[i, 0], points[i, 1], points[i, 2]
    count = 0
    for x in range(math.floor((px - reach) / cell_m), math.floor((px + reach) / cell_m) + 1):
        for y in range(math.floor((py - reach) / cell_m), math.floor((py + reach) / cell_m) + 1):
            low = cell_key(x, y, math.floor((pz - reach) / cell_m))
            high = cell_key(x, y, math.floor((pz + reach) / cell_m))
            j = first_at(keys, low)
            while j < len(keys) and keys[j] <= high:
                wx, wy, wz = references[j, 0] - px, references[j, 1] - py, references[j, 2] - pz
                if wx * wx + wy * wy + wz * wz <= reach * reach:
                    found[count] = j
                    count += 1
                j += 1
    return count


@inner("int64(int64)")
def bits_in(number: int) -> int:
    """Return how many bits of a number are set."""
    count = 0
    while number:
        number &= number - 1
        count += 1
    return count


@kernel(
    "UniTuple(float64[:,::1], 3)(float64[:,::1], float64[:,::1], float64[::1], float64[:,::1],"
    " float64[:,::1], float64[::1], float64[::1], float64[::1], int64[::1], boolean[::1],"
    " int64[::1], float64, float64, float64, float64)"
)
def shift_across(
    points: Floats,
    directions: Floats,
    radii: Floats,
    references: Floats,
    reference_directions: Floats,
    reference_radii: Floats,
    weights: Floats,
    probability: Floats,
    view_bits: Ints,
    fragment: NDArray[np.bool_],
    keys: Ints,
    cell_m: float,
    bandwidth_m: float,
    radius_share: float,
    min_cosine: float,
) -> tuple[Floats, Floats, Floats]:
    """Move points (P, 3) to the weighted mean of the references, across their direction only.

    References (R, 3) lie sorted by the `keys` of their cells of `cell_m`. The bandwidth is the
    larger of `bandwidth_m` and a share of the point's radius; references count within twice that
    and with |cos| of the angle between the directions of at least `min_cosine`. Returns the moved
    points, the mean directions, and the support (P, SUPPORT).
    """
    moved, turned = points.copy(), directions.copy()
    support, found = np.zeros((len(points), SUPPORT)), np.zeros(len(references), dtype=np.int64)
    for i in range(len(points)):
        px, py, pz = points[i, 0], points[i, 1], points[i, 2]
        width = max(bandwidth_m, radius_share * radii[i])
        total, bits = 0.0, 0
        ox = oy = oz = ex = ey = ez = r = mean_p = masks = largest = 0.0
        for n in range(near(points, i, 2.0 * width, references, keys, cell_m, found)):
            j = found[n]
            rx, ry = reference_directions[j, 0], reference_directions[j, 1]
            rz = reference_directions[j, 2]
            cosine = directions[i, 0] * rx + directions[i, 1] * ry + directions[i, 2] * rz
            if abs(cosine) < min_cosine:
                continue
            wx, wy, wz = references[j, 0] - px, references[j, 1] - py, references[j, 2] - pz
            weight = weights[j] * math.exp(-0.5 * (wx * wx + wy * wy + wz * wz) / (width * width))
            signed = weight if cosine > 0.0 else -weight
            total, masks = total + weight, masks + (0.0 if fragment[j] else weight)
            ox, oy, oz = ox + weight * wx, oy + weight * wy, oz + weight * wz
            ex, ey, ez = ex + signed * rx, ey + signed * ry, ez + signed * rz
            r, mean_p = r + weight * reference_radii[j], mean_p + weight * probability[j]
            largest, bits = max(largest, probability[j]), bits | view_bits[j]
        if draw((ox, oy, oz), (ex, ey, ez), total, moved[i], turned[i]):
            support[i, 0], support[i, 1], support[i, 2] = total, r / total, mean_p / total
            support[i, 3], support[i, 4], support[i, 5] = largest, bits_in(bits), masks / total
    return moved, turned, support


@kernel(
    "float64[:,:,::1](int64[::1], float64[:,::1], float64[:,::1], float64[::1], int64[::1],"
    " float64, float64, float64)"
)
def spread_around(
    chosen: Ints,
    directions: Floats,
    references: Floats,
    weights: Floats,
    keys: Ints,
    cell_m: float,
    bandwidth_m: float,
    own_share: float,
) -> Floats:
    """Return how the references (R, 3) lie around some of them: covariances (C, 3, 3).

    References lie sorted by the `keys` of their cells of `cell_m` and count within twice the
    bandwidth, with Gaussian weights. `own_share` of the bandwidth squared is added along their own
    `directions` (R, 3).
    """
    spread, found = np.zeros((len(chosen), 3, 3)), np.zeros(len(references), dtype=np.int64)
    way, mean = np.zeros(3), np.zeros(3)
    own = own_share * bandwidth_m**2
    for c in range(len(chosen)):
        i, total = chosen[c], 0.0
        for a in range(3):
            mean[a] = 0.0
        for n in range(near(references, i, 2 * bandwidth_m, references, keys, cell_m, found)):
            squared = 0.0
            for a in range(3):
                way[a] = references[found[n], a] - references[i, a]
                squared += way[a] * way[a]
            weight = weights[found[n]] * math.exp(-0.5 * squared / bandwidth_m**2)
            total += weight
            for a in range(3):
                mean[a] += weight * way[a]
                for b in range(3):
                    spread[c, a, b] += weight * way[a] * way[b]
        for a in range(3):
            for b in range(3):
                square = spread[c, a, b] - mean[a] * mean[b] / total
                spread[c, a, b] = square / total + own * directions[i, a] * directions[i, b]
    return spread


@kernel("boolean[::1](int64[::1], int64[::1], int64[::1])")
def thinned(order: Ints, start: Ints, neighbours: Ints) -> NDArray[np.bool_]:
    """Keep, in this order, each point none of whose neighbours is kept already."""
    kept = np.zeros(len(order), dtype=np.bool_)
    for n in range(len(order)):
        i, free = order[n], True
        for k in range(start[i], start[i + 1]):
            if kept[neighbours[k]]:
                free = False
                break
        kept[i] = free
    return kept
