"""Move points onto the curve their neighbours lie on."""

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from canopy_skel.kernels.blocks import find

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Int32s = NDArray[np.int32]


@njit(cache=True, nogil=True)
def cells_around(top: Int32s, origin: Ints, slots: Int32s, x: int, y: int, z: int) -> Ints:
    """Return the occupied cells among the 27 around (x, y, z)."""
    found = np.zeros(27, dtype=np.int64)
    count = 0
    for dx in range(-1, 2):
        for dy in range(-1, 2):
            for dz in range(-1, 2):
                cell = find(top, origin, slots, x + dx, y + dy, z + dz)
                if cell >= 0:
                    found[count] = cell
                    count += 1
    return found[:count]


@njit(cache=True, nogil=True)
def mean_shift_across(
    points: Floats,
    directions: Floats,
    references: Floats,
    reference_directions: Floats,
    cell_start: Ints,
    top: Int32s,
    origin: Ints,
    slots: Int32s,
    cell_m: float,
    bandwidth_m: float,
    min_cosine: float,
) -> tuple[Floats, Floats]:
    """Move points (P, 3) to the weighted mean of the references, across their direction only.

    References (R, 3) lie sorted by cells of `cell_m`: those of cell i at cell_start[i] up to
    cell_start[i + 1]. Only those within one cell length and with |cos| of the angle between the
    directions of at least `min_cosine` count, with Gaussian weights. Returns the moved points and
    the mean directions (P, 3).
    """
    moved = points.copy()
    turned = directions.copy()
    for i in range(len(points)):
        px, py, pz = points[i]
        dx, dy, dz = directions[i]
        total = ox = oy = oz = ex = ey = ez = 0.0
        x, y, z = math.floor(px / cell_m), math.floor(py / cell_m), math.floor(pz / cell_m)
        for cell in cells_around(top, origin, slots, x, y, z):
            for j in range(cell_start[cell], cell_start[cell + 1]):
                wx, wy, wz = references[j, 0] - px, references[j, 1] - py, references[j, 2] - pz
                squared = wx * wx + wy * wy + wz * wz
                rx, ry, rz = reference_directions[j]
                cosine = dx * rx + dy * ry + dz * rz
                if squared > cell_m * cell_m or abs(cosine) < min_cosine:
                    continue
                weight = math.exp(-0.5 * squared / (bandwidth_m * bandwidth_m))
                signed = weight if cosine > 0.0 else -weight
                total += weight
                ox, oy, oz = ox + weight * wx, oy + weight * wy, oz + weight * wz
                ex, ey, ez = ex + signed * rx, ey + signed * ry, ez + signed * rz
        norm = math.sqrt(ex * ex + ey * ey + ez * ez)
        if total > 0.0 and norm > 1e-9:
            ex, ey, ez = ex / norm, ey / norm, ez / norm
            ox, oy, oz = ox / total, oy / total, oz / total
            along = ox * ex + oy * ey + oz * ez
            moved[i] = (px + ox - along * ex, py + oy - along * ey, pz + oz - along * ez)
            turned[i] = (ex, ey, ez)
    return moved, turned
