"""Which points of one view lie along points of another."""

import numpy as np
from numpy.typing import NDArray

from canopy_skel.kernels.cells import most_rows, no_box, rows_around
from canopy_skel.kernels.compiled import kernel

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

AGREEMENT = 3
"""Columns: beside any point of the other view, along an instance's, along a fragment's."""


@kernel(
    "int64[:,::1](float64[:,::1], float64[:,::1], float64[:,::1], float64[:,::1], boolean[::1],"
    " int64[::1], float64, float64, float64, float64)"
)
def agreement(
    points: Floats,
    directions: Floats,
    references: Floats,
    reference_directions: Floats,
    fragment: NDArray[np.bool_],
    keys: Ints,
    cell_m: float,
    across_m: float,
    reach_m: float,
    min_cosine: float,
) -> Ints:
    """Say of points (P, 3) what points of another view (R, 3) they have near by, (P, AGREEMENT).

    References lie sorted by the `keys` of their cells of `cell_m`. Near is within `reach_m` and
    within `across_m` across the point's own direction; along is near and with |cos| of the angle
    between the directions of at least `min_cosine`.
    """
    found = np.zeros((len(points), AGREEMENT), dtype=np.int64)
    box, rows = no_box(), np.zeros((most_rows(reach_m, cell_m), 2), dtype=np.int64)
    for i in range(len(points)):
        px, py, pz = points[i, 0], points[i, 1], points[i, 2]
        dx, dy, dz = directions[i, 0], directions[i, 1], directions[i, 2]
        for row in range(rows_around(px, py, pz, reach_m, cell_m, keys, box, rows)):
            for j in range(rows[row, 0], rows[row, 1]):
                wx, wy, wz = references[j, 0] - px, references[j, 1] - py, references[j, 2] - pz
                squared = wx * wx + wy * wy + wz * wz
                along = wx * dx + wy * dy + wz * dz
                if squared <= reach_m**2 and squared - along * along <= across_m**2:
                    found[i, 0] = 1
                    cosine = dx * reference_directions[j, 0]
                    cosine += dy * reference_directions[j, 1]
                    cosine += dz * reference_directions[j, 2]
                    if abs(cosine) >= min_cosine:
                        found[i, 2 if fragment[j] else 1] = 1
    return found
