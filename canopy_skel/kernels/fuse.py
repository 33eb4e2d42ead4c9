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
    larger of `bandwidth_m`
    and a share of the point's radius; references count within twice that and with |cos| of the
    angle between the directions of at least `min_cosine`. Returns the moved points, the mean
    directions, and the support (P, SUPPORT).
    """
    moved = points.copy()
    turned = directions.copy()
    support = np.zeros((len(points), SUPPORT))
    for i in range(len(points)):
        px, py, pz = points[i]
        dx, dy, dz = directions[i]
        width = max(bandwidth_m, radius_share * radii[i])
        reach = 2.0 * width
        total = ox = oy = oz = ex = ey = ez = r = mean_p = masks = 0.0
        largest, bits = 0.0, 0
        for x in range(math.floor((px - reach) / cell_m), math.floor((px + reach) / cell_m) + 1):
            for y in range(
                math.floor((py - reach) / cell_m), math.floor((py + reach) / cell_m) + 1
            ):
                low = cell_key(x, y, math.floor((pz - reach) / cell_m))
                high = cell_key(x, y, math.floor((pz + reach) / cell_m))
                j = np.searchsorted(keys, low) - 1
                while j + 1 < len(keys) and keys[j + 1] <= high:
                    j += 1
                    wx = references[j, 0] - px
                    wy = references[j, 1] - py
                    wz = references[j, 2] - pz
                    squared = wx * wx + wy * wy + wz * wz
                    if squared > reach * reach:
                        continue
                    rx, ry, rz = reference_directions[j]
                    cosine = dx * rx + dy * ry + dz * rz
                    if abs(cosine) < min_cosine:
                        continue
                    weight = weights[j] * math.exp(-0.5 * squared / (width * width))
                    signed = weight if cosine > 0.0 else -weight
                    total += weight
                    ox, oy, oz = ox + weight * wx, oy + weight * wy, oz + weight * wz
                    ex, ey, ez = ex + signed * rx, ey + signed * ry, ez + signed * rz
                    r += weight * reference_radii[j]
                    mean_p += weight * probability[j]
                    largest = max(largest, probability[j])
                    bits |= view_bits[j]
                    if not fragment[j]:
                        masks += weight
        norm = math.sqrt(ex * ex + ey * ey + ez * ez)
        if total > 0.0 and norm > 1e-9:
            ex, ey, ez = ex / norm, ey / norm, ez / norm
            ox, oy, oz = ox / total, oy / total, oz / total
            along = ox * ex + oy * ey + oz * ez
            moved[i] = (px + ox - along * ex, py + oy - along * ey, pz + oz - along * ez)
            turned[i] = (ex, ey, ez)
            support[i, 0] = total
            support[i, 1] = r / total
            support[i, 2] = mean_p / total
            support[i, 3] = largest
            views = 0
            while bits:
                bits &= bits - 1
                views += 1
            support[i, 4] = views
            support[i, 5] = masks / total
    return moved, turned, support


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
