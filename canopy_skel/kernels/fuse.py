"""Draw points of many views onto the curve they lie on, and sum up what stands behind each."""

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
SUPPORT = 6
"""Columns: total weight, radius, mean p, largest p, views, share of weight from instances."""


@njit(cache=True, nogil=True)
def cell_key(x: int, y: int, z: int) -> int:
    """Return one number per cell; cells in a row along z follow one another."""
    return ((x + 1048576) << 42) | ((y + 1048576) << 21) | (z + 1048576)


@njit(cache=True, nogil=True)
def cell_keys(points: Floats, cell_m: float) -> Ints:
    """Return the number of the cell that each of (N, 3) points lies in."""
    keys = np.zeros(len(points), dtype=np.int64)
    for i in range(len(points)):
        x, y, z = points[i]
        keys[i] = cell_key(math.floor(x / cell_m), math.floor(y / cell_m), math.floor(z / cell_m))
    return keys


@njit(cache=True, nogil=True)
def near(
    point: Floats, reach: float, references: Floats, keys: Ints, cell_m: float, found: Ints
) -> int:
    """Write which references (R, 3), sorted by the `keys` of their cells, are within reach."""
    px, py, pz = point
    count = 0
    for x in range(math.floor((px - reach) / cell_m), math.floor((px + reach) / cell_m) + 1):
        for y in range(math.floor((py - reach) / cell_m), math.floor((py + reach) / cell_m) + 1):
            low = cell_key(x, y, math.floor((pz - reach) / cell_m))
            high = cell_key(x, y, math.floor((pz + reach) / cell_m))
            j = np.searchsorted(keys, low)
            while j < len(keys) and keys[j] <= high:
                wx, wy, wz = references[j, 0] - px, references[j, 1] - py, references[j, 2] - pz
                if wx * wx + wy * wy + wz * wz <= reach * reach:
                    found[count] = j
                    count += 1
                j += 1
    return count


@njit(cache=True, nogil=True)
def bits_in(number: int) -> int:
    """Return how many bits of a number are set."""
    count = 0
    while number:
        number &= number - 1
        count += 1
    return count


@njit(cache=True, nogil=True)
def draw(
    offset: tuple[float, float, float],
    heading: tuple[float, float, float],
    total: float,
    point: Floats,
    direction: Floats,
) -> bool:
    """Move a point by the mean of offsets, across the mean heading, which becomes its direction.

    False, and nothing is done, where the headings cancel out.
    """
    ex, ey, ez = heading
    norm = math.sqrt(ex * ex + ey * ey + ez * ez)
    if norm <= 1e-9:
        return False
    ex, ey, ez = ex / norm, ey / norm, ez / norm
    ox, oy, oz = offset[0] / total, offset[1] / total, offset[2] / total
    along = ox * ex + oy * ey + oz * ez
    point[0], point[1] = point[0] + ox - along * ex, point[1] + oy - along * ey
    point[2] = point[2] + oz - along * ez
    direction[0], direction[1], direction[2] = ex, ey, ez
    return True


@njit(cache=True, nogil=True)
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
        px, py, pz = points[i]
        width = max(bandwidth_m, radius_share * radii[i])
        total, bits = 0.0, 0
        ox = oy = oz = ex = ey = ez = r = mean_p = masks = largest = 0.0
        for j in found[: near(points[i], 2.0 * width, references, keys, cell_m, found)]:
            rx, ry, rz = reference_directions[j]
            cosine = directions[i, 0] * rx + directions[i, 1] * ry + directions[i, 2] * rz
            if abs(cosine) < min_cosine:
                continue
            wx, wy, wz = references[j, 0] - px, references[j, 1] - py, references[j, 2] - pz
            weight = weights[j] * math.exp(-0.5 * (wx * wx + wy * wy + wz * wz) / (width * width))
            signed = weight if cosine > 0.0 else -weight
            total += weight
            ox, oy, oz = ox + weight * wx, oy + weight * wy, oz + weight * wz
            ex, ey, ez = ex + signed * rx, ey + signed * ry, ez + signed * rz
            r += weight * reference_radii[j]
            mean_p += weight * probability[j]
            largest, bits = max(largest, probability[j]), bits | view_bits[j]
            masks += 0.0 if fragment[j] else weight
        if total > 0.0 and draw((ox, oy, oz), (ex, ey, ez), total, moved[i], turned[i]):
            support[i, :3] = (total, r / total, mean_p / total)
            support[i, 3:] = (largest, float(bits_in(bits)), masks / total)
    return moved, turned, support


@njit(cache=True, nogil=True)
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
    for c, i in enumerate(chosen):
        total, mean = 0.0, np.zeros(3)
        for j in found[: near(references[i], 2 * bandwidth_m, references, keys, cell_m, found)]:
            way = references[j] - references[i]
            weight = weights[j] * math.exp(-0.5 * (way * way).sum() / bandwidth_m**2)
            total += weight
            mean += weight * way
            for a in range(3):
                for b in range(3):
                    spread[c, a, b] += weight * way[a] * way[b]
        own = own_share * bandwidth_m**2
        for a in range(3):
            for b in range(3):
                square = spread[c, a, b] - mean[a] * mean[b] / total
                spread[c, a, b] = square / total + own * directions[i, a] * directions[i, b]
    return spread


@njit(cache=True, nogil=True)
def thinned(order: Ints, start: Ints, neighbours: Ints) -> NDArray[np.bool_]:
    """Keep, in this order, each point none of whose neighbours is kept already."""
    kept = np.zeros(len(order), dtype=np.bool_)
    for i in order:
        free = True
        for j in neighbours[start[i] : start[i + 1]]:
            if kept[j]:
                free = False
                break
        kept[i] = free
    return kept
