"""Principal axes and degree-one least squares of many point clusters at once (paper III-C).

Clusters lie one after the other: points of cluster i are start[i] to start[i + 1].
"""

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
SWEEPS = 12


@njit("void(float64[:,::1], float64[:,::1])", cache=True, nogil=True)
def diagonalise(matrix: Floats, vectors: Floats) -> None:
    """Turn a symmetric 3 x 3 matrix diagonal by Jacobi rotations; columns of `vectors` follow."""
    for i in range(3):
        for j in range(3):
            vectors[i, j] = 1.0 if i == j else 0.0
    for _ in range(SWEEPS):
        for p in range(2):
            for q in range(p + 1, 3):
                if matrix[p, q] == 0.0:
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


@njit("void(float64[:,::1], int64, int64, float64[:,::1], float64[::1])", cache=True, nogil=True)
def principal_frame(points: Floats, first: int, end: int, axes: Floats, mean: Floats) -> None:
    """Write the principal axes of points [first, end) as rows, longest first, and their mean.

    The sign of an axis is canonical: its largest component is positive.
    """
    spread, vectors = np.zeros((3, 3)), np.empty((3, 3))
    for i in range(3):
        mean[i] = 0.0
    for n in range(first, end):
        for i in range(3):
            mean[i] += points[n, i]
    for i in range(3):
        mean[i] /= end - first
    for n in range(first, end):
        x, y, z = points[n, 0] - mean[0], points[n, 1] - mean[1], points[n, 2] - mean[2]
        spread[0, 0] += x * x
        spread[0, 1] += x * y
        spread[0, 2] += x * z
        spread[1, 1] += y * y
        spread[1, 2] += y * z
        spread[2, 2] += z * z
    spread[1, 0], spread[2, 0], spread[2, 1] = spread[0, 1], spread[0, 2], spread[1, 2]
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


@njit(
    "void(float64[:,::1], int64, int64, float64[::1], int64, float64[:,::1], float64[::1],"
    " float64[:,::1])",
    cache=True,
    nogil=True,
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


@njit("void(float64[:,::1], float64[:,::1], int64)", cache=True, nogil=True)
def solve(matrix: Floats, right: Floats, count: int) -> None:
    """Solve the tridiagonal system in place (Cholesky without roots: it is positive definite)."""
    for i in range(1, count):
        factor = matrix[i - 1, 1] / matrix[i - 1, 0]
        matrix[i, 0] -= factor * matrix[i - 1, 1]
        for j in range(3):
            right[i, j] -= factor * right[i - 1, j]
    for back in range(count):
        i = count - 1 - back
        for j in range(3):
            if back > 0:
                right[i, j] -= matrix[i, 1] * right[i + 1, j]
            right[i, j] /= matrix[i, 0]


@njit(
    "void(float64[:,::1], int64[::1], int64, float64, float64[:,:,::1], float64[:,:,::1],"
    " float64[:,::1], int64[::1])",
    cache=True,
    nogil=True,
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
    of control points: fewer where some would have points of less than `min_weight`.
    """
    longest = 0
    for c in range(len(start) - 1):
        longest = max(longest, start[c + 1] - start[c])
    along, matrix, weight = np.empty(longest), np.empty((most, 2)), np.empty(most)
    for c in range(len(start) - 1):
        first, end = start[c], start[c + 1]
        principal_frame(points, first, end, axes[c], means[c])
        low, high = math.inf, -math.inf
        for n in range(first, end):
            t = 0.0
            for i in range(3):
                t += (points[n, i] - means[c, i]) * axes[c, 0, i]
            along[n - first] = t
            low, high = min(low, t), max(high, t)
        for n in range(end - first):
            along[n] = (along[n] - low) / max(high - low, 1e-12)
        count, enough = most, False
        while not enough:
            normal_equations(points, first, end, along, count, matrix, weight, controls[c])
            enough = count == 2
            lightest = math.inf
            for i in range(count):
                lightest = min(lightest, weight[i])
            if not enough and lightest < min_weight:
                count -= 1
            else:
                enough = True
        solve(matrix, controls[c], count)
        counts[c] = count


@njit(
    "void(float64[:,::1], int64[::1], float64[:,:,::1], float64[:,:,::1], float64[:,::1],"
    " int64[::1], float64[:,::1], float64[:,::1])",
    cache=True,
    nogil=True,
)
def half_widths(
    points: Floats,
    start: Ints,
    controls: Floats,
    axes: Floats,
    means: Floats,
    counts: Ints,
    sideways: Floats,
    widths: Floats,
) -> None:
    """Write half the extent along PC2, and sqrt(3) deviations from the spline along `sideways`."""
    for c in range(len(start) - 1):
        first, end, count = start[c], start[c + 1], counts[c]
        low, high = math.inf, -math.inf
        near, far = math.inf, -math.inf
        for n in range(first, end):
            t = u = 0.0
            for i in range(3):
                t += (points[n, i] - means[c, i]) * axes[c, 0, i]
                u += (points[n, i] - means[c, i]) * axes[c, 1, i]
            near, far = min(near, t), max(far, t)
            low, high = min(low, u), max(high, u)
        total = squares = 0.0
        for n in range(first, end):
            t = 0.0
            for i in range(3):
                t += (points[n, i] - means[c, i]) * axes[c, 0, i]
            place = (t - near) / max(far - near, 1e-12) * (count - 1)
            k = min(int(place), count - 2)
            off = 0.0
            for i in range(3):
                fitted = controls[c, k, i] + (place - k) * (
                    controls[c, k + 1, i] - controls[c, k, i]
                )
                off += (points[n, i] - fitted) * sideways[c, i]
            total += off
            squares += off * off
        mean = total / (end - first)
        variance = max(squares / (end - first) - mean * mean, 0.0)
        widths[c, 0], widths[c, 1] = (high - low) / 2.0, math.sqrt(3.0 * variance)
