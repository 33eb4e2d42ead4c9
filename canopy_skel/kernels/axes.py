"""Principal axes of three-dimensional points."""

import math

import numpy as np
from numpy.typing import NDArray

from canopy_skel.kernels.compiled import inner

Floats = NDArray[np.float64]

SWEEPS = 12


@inner("void(float64[:,::1], float64[:,::1])")
def diagonalise(matrix: Floats, vectors: Floats) -> None:
    """Turn a symmetric 3 x 3 matrix diagonal by Jacobi rotations; columns of `vectors` follow."""
    for i in range(3):
        for j in range(3):
            vectors[i, j] = 1.0 if i == j else 0.0
    for _ in range(SWEEPS):
        for p in range(2):
            for q in range(p + 1, 3):
                # Sizes: rounding leaves zeros of a flat or straight matrix slightly negative.
                if abs(matrix[p, q]) <= 1e-18 * (abs(matrix[p, p]) + abs(matrix[q, q])):
                    continue
                theta = (matrix[q, q] - matrix[p, p]) / (2.0 * matrix[p, q])
                sign = 1.0 if theta >= 0.0 else -1.0
                t = sign / (abs(theta) + math.sqrt(theta * theta + 1.0))
                c = 1.0 / math.sqrt(t * t + 1.0)
                s = t * c
                for i in range(3):
                    a, b = matrix[i, p], matrix[i, q]
                    matrix[i, p], matrix[i, q] = c * a - s * b, s * a + c * b
                for i in range(3):
                    a, b = matrix[p, i], matrix[q, i]
                    matrix[p, i], matrix[q, i] = c * a - s * b, s * a + c * b
                for i in range(3):
                    a, b = vectors[i, p], vectors[i, q]
                    vectors[i, p], vectors[i, q] = c * a - s * b, s * a + c * b


@inner("void(float64[:,::1], int64, int64, float64[::1], float64[:,::1])")
def scatter_of(points: Floats, first: int, end: int, mean: Floats, spread: Floats) -> None:
    """Write the mean of points [first, end) and the matrix (3, 3) of their squared deviations."""
    mx = my = mz = xx = xy = xz = yy = yz = zz = 0.0
    for n in range(first, end):
        mx, my, mz = mx + points[n, 0], my + points[n, 1], mz + points[n, 2]
    mx, my, mz = mx / (end - first), my / (end - first), mz / (end - first)
    for n in range(first, end):
        x, y, z = points[n, 0] - mx, points[n, 1] - my, points[n, 2] - mz
        xx, xy, xz = xx + x * x, xy + x * y, xz + x * z
        yy, yz, zz = yy + y * y, yz + y * z, zz + z * z
    mean[0], mean[1], mean[2] = mx, my, mz
    spread[0, 0], spread[1, 1], spread[2, 2] = xx, yy, zz
    spread[0, 1] = spread[1, 0] = xy
    spread[0, 2] = spread[2, 0] = xz
    spread[1, 2] = spread[2, 1] = yz
