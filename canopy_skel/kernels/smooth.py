"""Move points onto the curve their neighbours lie on."""

import math

import numpy as np
from numpy.typing import NDArray

from canopy_skel.kernels.across import draw
from canopy_skel.kernels.compiled import kernel
from canopy_skel.kernels.grid import find

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Int32s = NDArray[np.int32]


@kernel(
    "Tuple((float64[:,::1], float64[:,::1]))(float64[:,::1], float64[:,::1], float64[:,::1],"
    " int64[::1], int32[:,:,::1], int64[::1], int32[:,::1], float64, float64, float64)"
)
def mean_shift_across(
    points: Floats,
    directions: Floats,
    references: Floats,
    cell_start: Ints,
    top: Int32s,
    origin: Ints,
    slots: Int32s,
    cell_m: float,
    bandwidth_m: float,
    min_cosine: float,
) -> tuple[Floats, Floats]:
    """Move points (P, 3) to the weighted mean of the references, across their direction only.

    References (R, 7), each a position, a unit direction and a weight, lie sorted by cells of
    `cell_m`: those of cell i at cell_start[i] up to cell_start[i + 1]. Only those within one cell
    length and with |cos| of the angle between the directions of at least `min_cosine` count, with
    Gaussian weights times their own. Returns the moved points and the mean directions (P, 3).
    """
    moved, turned = np.empty((len(points), 3)), np.empty((len(points), 3))
    falloff = -0.5 / (bandwidth_m * bandwidth_m)
    for i in range(len(points)):
        px, py, pz = points[i, 0], points[i, 1], points[i, 2]
        dx, dy, dz = directions[i, 0], directions[i, 1], directions[i, 2]
        total = ox = oy = oz = ex = ey = ez = 0.0
        x, y, z = math.floor(px / cell_m), math.floor(py / cell_m), math.floor(pz / cell_m)
        for k in range(27):
            cell = find(top, origin, slots, x + k // 9 - 1, y + k // 3 % 3 - 1, z + k % 3 - 1)
            if cell < 0:
                continue
            for j in range(cell_start[cell], cell_start[cell + 1]):
                wx = references[j, 0] - px
                wy = references[j, 1] - py
                wz = references[j, 2] - pz
                squared = wx * wx + wy * wy + wz * wz
                rx, ry, rz = references[j, 3], references[j, 4], references[j, 5]
                cosine = dx * rx + dy * ry + dz * rz
                if squared > cell_m * cell_m or abs(cosine) < min_cosine:
                    continue
                weight = references[j, 6] * math.exp(falloff * squared)
                signed = weight if cosine > 0.0 else -weight
                total += weight
                ox, oy, oz = ox + weight * wx, oy + weight * wy, oz + weight * wz
                ex, ey, ez = ex + signed * rx, ey + signed * ry, ez + signed * rz
        moved[i, 0], moved[i, 1], moved[i, 2] = px, py, pz
        turned[i, 0], turned[i, 1], turned[i, 2] = dx, dy, dz
        draw((ox, oy, oz), (ex, ey, ez), total, moved[i], turned[i])
    return moved, turned
