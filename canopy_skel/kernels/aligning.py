"""How far points of a view lie off the fused skeleton, and which small motion takes that away."""

import numpy as np
from numpy.typing import NDArray

from canopy_skel.kernels.cells import most_rows, no_box, rows_around
from canopy_skel.kernels.compiled import kernel

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


@kernel(
    "Tuple((int64[::1], int64[::1], float64[:,::1]))(float64[:,::1], float64[:,::1],"
    " float64[:,::1], float64[:,::1], int64[::1], float64, float64)"
)
def offsets(
    points: Floats,
    directions: Floats,
    vertices: Floats,
    vertex_directions: Floats,
    keys: Ints,
    reach_m: float,
    min_cosine: float,
) -> tuple[Ints, Ints, Floats]:
    """Return which points (P, 3) have a vertex within reach that runs along them, and which one.

    Of each the nearest vertex is asked. Also returns the way there across the vertex's direction.
    Vertices (V, 3) lie sorted by the `keys` of their cells of `reach_m`.
    """
    near, index = np.empty(len(points), dtype=np.int64), np.empty(len(points), dtype=np.int64)
    off, count = np.empty((len(points), 3)), 0
    box, rows = no_box(), np.zeros((most_rows(reach_m, reach_m), 2), dtype=np.int64)
    for i in range(len(points)):
        px, py, pz = points[i, 0], points[i, 1], points[i, 2]
        best, least = -1, reach_m * reach_m
        for row in range(rows_around(px, py, pz, reach_m, reach_m, keys, box, rows)):
            for j in range(rows[row, 0], rows[row, 1]):
                wx, wy, wz = vertices[j, 0] - px, vertices[j, 1] - py, vertices[j, 2] - pz
                squared = wx * wx + wy * wy + wz * wz
                if squared < least:
                    best, least = j, squared
        if best < 0:
            continue
        dx, dy = vertex_directions[best, 0], vertex_directions[best, 1]
        dz = vertex_directions[best, 2]
        cosine = directions[i, 0] * dx + directions[i, 1] * dy + directions[i, 2] * dz
        if abs(cosine) > min_cosine:
            wx, wy, wz = vertices[best, 0] - px, vertices[best, 1] - py, vertices[best, 2] - pz
            along = wx * dx + wy * dy + wz * dz
            near[count], index[count] = i, best
            off[count, 0], off[count, 1] = wx - along * dx, wy - along * dy
            off[count, 2] = wz - along * dz
            count += 1
    return near[:count].copy(), index[:count].copy(), off[:count].copy()


@kernel("float64[:,::1](float64[:,::1], float64[:,::1], float64[:,::1], float64[::1])")
def normal_equations(arms: Floats, off: Floats, directions: Floats, weights: Floats) -> Floats:
    """Return the normal equations (6, 7), the right side last, of a shift and a turn.

    They move points at `arms` (N, 3) from the centre of turning by `off` (N, 3), as far as that is
    seen across `directions` (N, 3).
    """
    equations, row = np.zeros((6, 7)), np.zeros((6, 3))
    for n in range(len(arms)):
        x, y, z = arms[n, 0], arms[n, 1], arms[n, 2]
        for j in range(6):
            for i in range(3):
                row[j, i] = 1.0 if i == j else 0.0
        row[3, 1], row[3, 2] = -z, y
        row[4, 0], row[4, 2] = z, -x
        row[5, 0], row[5, 1] = -y, x
        for j in range(6):
            along = row[j, 0] * directions[n, 0] + row[j, 1] * directions[n, 1]
            along += row[j, 2] * directions[n, 2]
            for i in range(3):
                row[j, i] -= along * directions[n, i]
        for i in range(3):
            for j in range(6):
                weighted = row[j, i] * weights[n]
                for k in range(6):
                    equations[j, k] += weighted * row[k, i]
                equations[j, 6] += weighted * off[n, i]
    return equations
