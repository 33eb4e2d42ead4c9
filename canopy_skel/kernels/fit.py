"""Principal axes and degree-one least squares of many point clusters at once (paper III-C).

Clusters lie one after the other: points of cluster i are start[i] to start[i + 1].
"""

import math

import numpy as np
from numpy.typing import NDArray

from canopy_skel.kernels.axes import diagonalise, scatter_of
from canopy_skel.kernels.compiled import inner, kernel

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
SINGULAR = 1e-6
"""Share of a diagonal entry that elimination must leave; rounding leaves some 1e-16 of it."""


@inner("void(float64[:,::1], int64, int64, float64[:,::1], float64[::1])")
def principal_frame(points: Floats, first: int, end: int, axes: Floats, mean: Floats) -> None:
    """Write the principal axes of points [first, end) as rows, longest first, and their mean.

    The sign of an axis is canonical: its largest component is positive.
    """
    spread, vectors = np.empty((3, 3)), np.empty((3, 3))
    scatter_of(points, first, end, mean, spread)
    diagonalise(spread, vectors)
    used = np.zeros(3)
    for row in range(3):
        best = -1
        for j in range(3):
            if used[j] == 0.0 and (best < 0 or spread[j, j] > spread[best, best]):
                best = j
        used[best] = 1.0
        largest = 0
        for i in range(1, 3):
            if abs(vectors[i, best]) > abs(vectors[largest, best]):
                largest = i
        sign = 1.0 if vectors[largest, best] > 0.0 else -1.0
        for i in range(3):
            axes[row, i] = sign * vectors[i, best]


@inner(
    "void(float64[:,::1], int64, int64, float64[::1], int64, float64[:,::1], float64[::1],"
    " float64[:,::1])"
)
def normal_equations(
    points: Floats,
    first: int,
    end: int,
    along: Floats,
    count: int,
    matrix: Floats,
    weight: Floats,
    right: Floats,
) -> None:
    """Write the tridiagonal normal matrix (diagonal, off-diagonal), basis sums and right sides."""
    for i in range(count):
        matrix[i, 0] = matrix[i, 1] = weight[i] = 0.0
        right[i, 0] = right[i, 1] = right[i, 2] = 0.0
    for n in range(first, end):
        place = along[n - first] * (count - 1)
        i = min(int(place), count - 2)
        b = place - i
        a = 1.0 - b
        weight[i] += a
        weight[i + 1] += b
        matrix[i, 0] += a * a
        matrix[i, 1] += a * b
        matrix[i + 1, 0] += b * b
        for j in range(3):
            right[i, j] += a * points[n, j]
            right[i + 1, j] += b * points[n, j]


@inner("boolean(float64[:,::1], float64[:,::1], int64)")
def solve(matrix: Floats, right: Floats, count: int) -> bool:
    """Solve the tridiagonal system in place (Cholesky without roots), if it is positive definite.

    It is not where the points near two knots all have one place between them.
    """
    for i in range(1, count):
        factor = matrix[i - 1, 1] / matrix[i - 1, 0]
        least = SINGULAR * matrix[i, 0]
        matrix[i, 0] -= factor * matrix[i - 1, 1]
        if matrix[i, 0] <= least:
            return False
        for j in range(3):
            right[i, j] -= factor * right[i - 1, j]
    for back in range(count):
        i = count - 1 - back
        for j in range(3):
            if back > 0:
                right[i, j] -= matrix[i, 1] * right[i + 1, j]
            right[i, j] /= matrix[i, 0]
    return True


@kernel(
    "void(float64[:,::1], int64[::1], int64, float64, float64[:,:,::1], float64[:,:,::1],"
    " float64[:,::1], int64[::1])"
)
def fit_splines(
    points: Floats,
    start: Ints,
    most: int,
    min_weight: float,
    controls: Floats,
    axes: Floats,
    means: Floats,
    counts: Ints,
) -> None:
    """Fit a spline of up to `most` control points, uniform knots along PC1, to every cluster.

    Writes the control points (C, most, 3), principal axes (C, 3, 3), means (C, 3) and the numbers
    of control points: fewer where some would have points of less than `min_weight`, or points would
    not tell them apart.
    """
    longest = 0
    for c in range(len(start) - 1):
        longest = max(longest, start[c + 1] - start[c])
    along, matrix, weight = np.empty(longest), np.empty((most, 2)), np.empty(most)
    for c in range(len(start) - 1):
        first, end = start[c], start[c + 1]
        principal_frame(points, first, end, axes[c], means[c])
        ax, ay, az = axes[c, 0, 0], axes[c, 0, 1], axes[c, 0, 2]
        shift = means[c, 0] * ax + means[c, 1] * ay + means[c, 2] * az
        low, high = math.inf, -math.inf
        for n in range(first, end):
            t = points[n, 0] * ax + points[n, 1] * ay + points[n, 2] * az - shift
            along[n - first] = t
            low, high = min(low, t), max(high, t)
        scale = 1.0 / max(high - low, 1e-12)
        for n in range(end - first):
            along[n] = min((along[n] - low) * scale, 1.0)
        count, solved = most + 1, False
        while not solved and count > 2:
            count -= 1
            normal_equations(points, first, end, along, count, matrix, weight, controls[c])
            lightest = math.inf
            for i in range(count):
                lightest = min(lightest, weight[i])
            if count == 2 or lightest >= min_weight:
                solved = solve(matrix, controls[c], count)
        if not solved:  # All points are one.
            for j in range(3):
                controls[c, 0, j] = controls[c, 1, j] = means[c, j]
        counts[c] = count


@kernel("void(float64[:,::1], int64[::1], float64[:,:,::1], float64[::1])")
def half_extents(points: Floats, start: Ints, axes: Floats, extents: Floats) -> None:
    """Write half the extent of every cluster along PC2."""
    for c in range(len(start) - 1):
        low, high = math.inf, -math.inf
        for n in range(start[c], start[c + 1]):
            across = 0.0
            for j in range(3):
                across += points[n, j] * axes[c, 1, j]
            low, high = min(low, across), max(high, across)
        extents[c] = (high - low) / 2.0
