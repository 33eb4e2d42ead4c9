"""Fit the centre line of a slender region in the picture and its disparity profile along it."""

import math

import numpy as np
from numpy.typing import NDArray

from canopy_skel.kernels.compiled import inner, kernel
from canopy_skel.kernels.median import median_of

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
MAX_KNOTS = 8
QUALITY = 6
"""Columns: pixels, length_px, width_px, valid share, inlier share, lateral deviation / width."""
DRAWS = 60
ROUNDS = 6
"""Of reweighted least squares."""


@inner("Tuple((int64, float64))(float64, int64)")
def hats(x: float, count: int) -> tuple[int, float]:
    """Return the knot left of x in [0, 1] and the weight of the one right of it."""
    place = min(max(x, 0.0), 1.0) * (count - 1)
    left = min(int(place), count - 2)
    return left, place - left


@inner("float64(float64[::1], float64)")
def at(values: Floats, x: float) -> float:
    """Return the value at x of the polyline with these values at its knots."""
    left, b = hats(x, len(values))
    return float((1.0 - b) * values[left] + b * values[left + 1])


@inner("void(float64[:,::1], float64[::1])")
def solve_banded(matrix: Floats, right: Floats) -> None:
    """Solve a positive definite system in place; matrix (n, 3): diagonal, first, second above it.

    LDL' without square roots.
    """
    n = len(right)
    for i in range(n):
        for below in range(1, min(3, n - i)):
            factor = matrix[i, below] / matrix[i, 0]
            for j in range(below, min(3, n - i)):
                matrix[i + below, j - below] -= factor * matrix[i, j]
            right[i + below] -= factor * right[i]
    for back in range(n):
        i = n - 1 - back
        for above in range(1, min(3, n - i)):
            right[i] -= matrix[i, above] * right[i + above]
        right[i] /= matrix[i, 0]


@inner(
    "void(float64[::1], float64[::1], float64[::1], float64, float64[::1], float64, float64[::1])"
)
def fit_hats(
    x: Floats, y: Floats, weight: Floats, bend: float, prior: Floats, pull: float, values: Floats
) -> None:
    """Write the values at uniform knots of the weighted least-squares polyline.

    `bend` weighs squared second differences, `pull` squared distances from `prior`; both times
    the points per knot.
    """
    count = len(values)
    normal, share = np.zeros((count, 3)), len(x) / count
    for k in range(count):
        values[k] = 0.0
    for i in range(len(x)):
        left, b = hats(x[i], count)
        a, w = 1.0 - b, weight[i]
        normal[left, 0] += w * a * a
        normal[left, 1] += w * a * b
        normal[left + 1, 0] += w * b * b
        values[left] += w * a * y[i]
        values[left + 1] += w * b * y[i]
    for k in range(count):
        normal[k, 0] += pull * share + 1e-9
        values[k] += pull * share * prior[k] + 1e-9 * prior[k]
    for k in range(1, count - 1):
        normal[k - 1, 0] += bend * share
        normal[k - 1, 1] -= 2.0 * bend * share
        normal[k - 1, 2] += bend * share
        normal[k, 0] += 4.0 * bend * share
        normal[k, 1] -= 2.0 * bend * share
        normal[k + 1, 0] += bend * share
    solve_banded(normal, values)


@inner("float64(float64, float64)")
def tolerance_at(disparity: float, tolerance_m: float) -> float:
    """Return what a tolerance in depth is in disparity (1/m); constant beyond 1.25 m."""
    near = max(disparity, 0.8)
    return tolerance_m * (near * near)


@inner("UniTuple(float64, 2)(float64[::1], float64[::1], float64, float64, float64)")
def best_line(
    x: Floats, d: Floats, middle: float, steepest: float, tolerance_m: float
) -> tuple[float, float]:
    """Return disparity at x = 0 and its slope of the line through two points that fits best.

    Or of the level one through the median, `middle`. Misfits count up to the tolerance (truncated
    L1); a large region is judged by every n-th point.
    """
    n = len(x)
    step = max(1, n // 256)
    state = 12345
    best_0, best_slope, best_misfit = middle, 0.0, math.inf
    for draw in range(DRAWS + 1):
        at_0, slope = middle, 0.0
        if draw > 0:
            state = (state * 1103515245 + 12345) % 2147483648
            i = (state >> 8) % n
            state = (state * 1103515245 + 12345) % 2147483648
            j = (state >> 8) % n
            run = x[j] - x[i]
            if abs(run) < 0.15:
                continue
            slope = (d[j] - d[i]) / run
            if abs(slope) > steepest:
                continue
            at_0 = d[i] - slope * x[i]
        misfit = 0.0
        for k in range(0, n, step):
            line = at_0 + slope * x[k]
            misfit += min(abs(d[k] - line) / tolerance_at(line, tolerance_m), 1.0)
        if misfit < best_misfit:
            best_0, best_slope, best_misfit = at_0, slope, misfit
    return best_0, best_slope


@inner("UniTuple(float64, 4)(float64[::1], float64[::1], float64[::1])")
def principal_axis(u: Floats, v: Floats, way: Floats) -> tuple[float, float, float, float]:
    """Return the mean (2) and the unit axis (2) of largest spread; its larger part is positive.

    way: (2,) added to the difference of the spreads along u and v, and to twice what they share.
    """
    n = len(u)
    mu = mv = uu = uv = vv = 0.0
    for i in range(n):
        mu, mv = mu + u[i], mv + v[i]
    mu, mv = mu / n, mv / n
    for i in range(n):
        du, dv = u[i] - mu, v[i] - mv
        uu, uv, vv = uu + du * du, uv + du * dv, vv + dv * dv
    angle = 0.5 * math.atan2(2.0 * (uv / n) + way[1], uu / n - vv / n + way[0])
    return mu, mv, math.cos(angle), math.sin(angle)


@inner("void(float64[::1], float64[::1], float64, float64, float64, float64[::1])")
def fit_disparity(
    x: Floats, d: Floats, f_px: float, span_px: float, tolerance_m: float, values: Floats
) -> None:
    """Write the robust profile of disparity d at x in [0, 1]: a line, then reweighted."""
    count, n = len(values), len(x)
    weight, line = np.empty(n), np.empty(count)
    for i in range(n):
        weight[i] = d[i]
    middle = median_of(weight)
    at_0, slope = best_line(x, d, middle, 4.0 * middle / f_px * span_px, tolerance_m)
    for k in range(count):
        line[k] = max(at_0 + slope * k / (count - 1), 1e-3)
        values[k] = line[k]
    for _ in range(ROUNDS):
        for i in range(n):
            fit = at(values, x[i])
            r = abs(d[i] - fit) / tolerance_at(fit, tolerance_m)
            weight[i] = (1.0 - r * r) * (1.0 - r * r) if r < 1.0 else 0.0
        fit_hats(x, d, weight, 0.1, line, 0.01, values)


@inner("Tuple((int64, float64, float64))(float64[::1], float64[::1], float64[::1], float64)")
def reached(x: Floats, d: Floats, values: Floats, tolerance_m: float) -> tuple[int, float, float]:
    """Return how many points lie on a profile, and the first and last place of them."""
    inliers, first, last = 0, 2.0, -1.0
    for i in range(len(x)):
        fit = at(values, x[i])
        if abs(d[i] - fit) <= tolerance_at(fit, tolerance_m):
            inliers += 1
            first, last = min(first, x[i]), max(last, x[i])
    return inliers, first, last


@inner(
    "UniTuple(float64, 2)(float64[::1], float64[::1], UniTuple(float64, 4), float64[::1],"
    " float64[::1])"
)
def straightened(
    u: Floats, v: Floats, axis: tuple[float, float, float, float], x: Floats, aside: Floats
) -> tuple[float, float]:
    """Write where pixels lie along an axis (mean, direction), 0 to 1, and how far aside of it.

    Returns the first place along it and the span of all, in pixels.
    """
    mu, mv, au, av = axis
    low, high = math.inf, -math.inf
    for i in range(len(u)):
        x[i] = (u[i] - mu) * au + (v[i] - mv) * av
        aside[i] = (v[i] - mv) * au - (u[i] - mu) * av
        low, high = min(low, x[i]), max(high, x[i])
    span = max(high - low, 1.0)
    for i in range(len(u)):
        x[i] = (x[i] - low) / span
    return low, span


@inner("float64(float64[::1], float64[::1], float64[::1])")
def fit_aside(x: Floats, aside: Floats, lateral: Floats) -> float:
    """Write the polyline through points; return their root mean squared deviation from it."""
    weight, flat = np.empty(len(x)), np.empty(len(lateral))
    for i in range(len(x)):
        weight[i] = 1.0
    for k in range(len(lateral)):
        flat[k] = 0.0
    fit_hats(x, aside, weight, 0.2, flat, 0.002, lateral)
    squares = 0.0
    for i in range(len(x)):
        left, b = hats(x[i], len(lateral))
        off = aside[i] - (1.0 - b) * lateral[left] - b * lateral[left + 1]
        squares += off * off
    return math.sqrt(squares / len(x))


@inner("int64(float64[::1], float64[::1], float64[::1])")
def seen(z: Floats, x: Floats, d: Floats) -> int:
    """Move places that have depth to the front, write their disparity; return how many have."""
    valid = 0
    for i in range(len(z)):
        if math.isfinite(z[i]):
            x[valid], d[valid] = x[i], 1.0 / z[i]
            valid += 1
    return valid


@inner(
    "int64(float64[::1], float64[::1], float64[::1], float64[::1], float64, float64, int64,"
    " float64, float64, float64, float64[:,::1], float64[::1])"
)
def fit_region(
    u: Floats,
    v: Floats,
    z: Floats,
    way: Floats,
    f_px: float,
    knot_px: float,
    max_knots: int,
    tolerance_m: float,
    min_valid: float,
    least_disparity: float,
    knots: Floats,
    quality: Floats,
) -> int:
    """Fit one region of N pixels (u, v) with depth z (NaN where there is none).

    way: (2,) what is known of its direction beforehand, see `fit_regions`.

    Writes rows (u, v, disparity) per knot and the quality; returns the number of knots, 0 where
    there is too little depth.
    """
    n = len(u)
    if n == 0:
        return 0
    x, d = np.empty(n), np.empty(n)
    axis = principal_axis(u, v, way)
    low, span = straightened(u, v, axis, x, d)
    count = min(max(int(span / knot_px + 0.5) + 1, 2), max_knots)
    lateral, values = np.empty(count), np.empty(count)
    quality[0], quality[1], quality[2] = n, span + 1.0, n / (span + 1.0)
    quality[5] = fit_aside(x, d, lateral) / quality[2]
    valid = seen(z, x, d)
    quality[3] = valid / n
    if valid < 3 or valid < min_valid * n:
        return 0
    fit_disparity(x[:valid], d[:valid], f_px, span, tolerance_m, values)
    inliers, first, last = reached(x[:valid], d[:valid], values, tolerance_m)
    quality[4] = inliers / valid
    least = math.inf
    for k in range(count):
        least = min(least, values[k])
    if inliers < 3 or least <= least_disparity:
        return 0
    mu, mv, au, av = axis
    for k in range(count):
        place = first + (last - first) * k / (count - 1)
        here, side = low + place * span, at(lateral, place)
        knots[k, 0] = mu + here * au - side * av
        knots[k, 1] = mv + here * av + side * au
        knots[k, 2] = at(values, place)
    return count


@kernel(
    "Tuple((int64[::1], float64[:,:,::1], float64[:,::1]))(float64[::1], float64[::1],"
    " float64[::1], int64[::1], float64[:,::1], float64, float64, int64, float64, float64, float64)"
)
def fit_regions(
    u: Floats,
    v: Floats,
    z: Floats,
    start: Ints,
    ways: Floats,
    f_px: float,
    knot_px: float,
    max_knots: int,
    tolerance_m: float,
    min_valid: float,
    least_disparity: float,
) -> tuple[Ints, Floats, Floats]:
    """Fit R regions; region i holds the pixels start[i] up to start[i + 1].

    ways: (R, 2) cos 2θ and sin 2θ of directions (u right, v down) known beforehand, times the
    difference of squared spreads (px²) along and across at which they count as much as the pixels.
    least_disparity: a region whose line runs on to less (1/m) is none.

    Returns knots per region (R,), rows (R, MAX_KNOTS, 3) of (u, v, disparity), quality (R, Q).
    """
    regions = len(start) - 1
    counts = np.zeros(regions, dtype=np.int64)
    knots = np.zeros((regions, MAX_KNOTS, 3))
    quality = np.zeros((regions, QUALITY))
    for i in range(regions):
        a, b = start[i], start[i + 1]
        counts[i] = fit_region(
            u[a:b], v[a:b], z[a:b], ways[i], f_px, knot_px, max_knots, tolerance_m, min_valid,
            least_disparity, knots[i], quality[i],
        )  # fmt: skip
    return counts, knots, quality


@inner("float64(float64[::1])")
def norm(vector: Floats) -> float:
    """Return the length of a vector (3,)."""
    return math.sqrt(vector[0] * vector[0] + vector[1] * vector[1] + vector[2] * vector[2])


@kernel("void(float64[:,:,::1], int64[::1], float64[::1])")
def shift_away(points: Floats, counts: Ints, shift_m: Floats) -> None:
    """Move the knots (R, MAX_KNOTS, 3) of R lines, the first counts[i] of each, away from the eye.

    By shift_m (R,), along the part of the ray across the line; not where that is next to nothing.
    """
    line, along, ray = np.empty((MAX_KNOTS, 3)), np.empty(3), np.empty(3)
    for i in range(len(counts)):
        for k in range(counts[i]):
            for c in range(3):
                line[k, c] = points[i, k, c]
        for k in range(counts[i]):
            before, after = max(k - 1, 0), min(k + 1, counts[i] - 1)
            for c in range(3):
                along[c], ray[c] = line[after, c] - line[before, c], line[k, c]
            long, far = max(norm(along), 1e-12), norm(ray)
            dot = 0.0
            for c in range(3):
                along[c], ray[c] = along[c] / long, ray[c] / far
                dot += ray[c] * along[c]
            for c in range(3):
                ray[c] -= dot * along[c]
            across = norm(ray)
            if across > 0.05:
                for c in range(3):
                    points[i, k, c] += shift_m[i] / across * ray[c]


@kernel("Tuple((float64[:,::1], float64[:,::1], int64[::1]))(float64[:,::1], int64[::1], float64)")
def sample_lines(knots: Floats, start: Ints, step_m: float) -> tuple[Floats, Floats, Ints]:
    """Return points at most `step_m` apart along lines, unit directions, the line of each.

    Line i has the knots (N, 3) start[i] up to start[i + 1]; one of no length has no points.
    """
    length, step = np.zeros(len(knots)), np.empty(3)
    ways, counts = np.zeros(len(start) - 1), np.zeros(len(start) - 1, dtype=np.int64)
    total = 0
    for i in range(len(counts)):
        for k in range(start[i], start[i + 1] - 1):
            for c in range(3):
                step[c] = knots[k + 1, c] - knots[k, c]
            length[k] = norm(step)
            ways[i] += length[k]
        if ways[i] >= 1e-6:
            counts[i] = max(2, math.ceil(ways[i] / step_m) + 1)
        total += counts[i]
    points, directions = np.zeros((total, 3)), np.zeros((total, 3))
    of, n = np.zeros(total, dtype=np.int64), 0
    for i in range(len(counts)):
        k, before = start[i], 0.0
        for j in range(counts[i]):
            at = ways[i] * j / (counts[i] - 1)
            while k < start[i + 1] - 2 and at >= before + length[k]:
                before += length[k]
                k += 1
            for c in range(3):
                unit = (knots[k + 1, c] - knots[k, c]) / max(length[k], 1e-12)
                points[n, c], directions[n, c] = knots[k, c] + (at - before) * unit, unit
            of[n] = i
            n += 1
    return points, directions, of
