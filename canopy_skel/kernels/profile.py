"""Fit the centre line of a slender region in the picture and its disparity profile along it."""

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
MAX_KNOTS = 8
QUALITY = 6
"""Columns: pixels, length_px, width_px, valid share, inlier share, lateral deviation / width."""


@njit(cache=True, nogil=True)
def hats(x: float, count: int) -> tuple[int, float]:
    """Return the knot left of x in [0, 1] and the weight of the one right of it."""
    place = min(max(x, 0.0), 1.0) * (count - 1)
    left = min(int(place), count - 2)
    return left, place - left


@njit(cache=True, nogil=True)
def fit_hats(
    x: Floats, y: Floats, weight: Floats, count: int, bend: float, prior: Floats, pull: float
) -> Floats:
    """Return the values (count,) at uniform knots of the weighted least-squares polyline.

    `bend` weighs squared second differences, `pull` squared distances from `prior`; both times
    the points per knot.
    """
    normal = np.zeros((count, count))
    right = np.zeros(count)
    for i in range(len(x)):
        left, b = hats(x[i], count)
        a, w = 1.0 - b, weight[i]
        normal[left, left] += w * a * a
        normal[left, left + 1] += w * a * b
        normal[left + 1, left] += w * a * b
        normal[left + 1, left + 1] += w * b * b
        right[left] += w * a * y[i]
        right[left + 1] += w * b * y[i]
    share = len(x) / count
    for k in range(count):
        normal[k, k] += pull * share + 1e-9
        right[k] += pull * share * prior[k] + 1e-9 * prior[k]
    for k in range(1, count - 1):
        for i, p in ((k - 1, 1.0), (k, -2.0), (k + 1, 1.0)):
            for j, q in ((k - 1, 1.0), (k, -2.0), (k + 1, 1.0)):
                normal[i, j] += bend * share * p * q
    return np.linalg.solve(normal, right).astype(np.float64)


@njit(cache=True, nogil=True)
def best_line(
    x: Floats, d: Floats, steepest: float, draws: int, tolerance_m: float
) -> tuple[float, float]:
    """Return disparity at x = 0 and its slope of the line through two points that fits best.

    Misfits count up to the tolerance (truncated L1); a large region is judged by every n-th point.
    """
    n = len(x)
    step = max(1, n // 256)
    state = 12345
    middle = float(np.median(d))
    best_0, best_slope, best_misfit = middle, 0.0, np.inf
    for draw in range(draws + 1):
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
            tolerance = tolerance_m * max(line, 0.8) ** 2
            misfit += min(abs(d[k] - line) / tolerance, 1.0)
        if misfit < best_misfit:
            best_0, best_slope, best_misfit = at_0, slope, misfit
    return best_0, best_slope


@njit(cache=True, nogil=True)
def principal_axis(u: Floats, v: Floats) -> tuple[float, float, float, float]:
    """Return the mean (2) and the unit axis (2) of largest spread; its larger part is positive."""
    mu, mv = u.mean(), v.mean()
    uu = ((u - mu) ** 2).mean()
    vv = ((v - mv) ** 2).mean()
    uv = ((u - mu) * (v - mv)).mean()
    angle = 0.5 * math.atan2(2.0 * uv, uu - vv)
    return mu, mv, math.cos(angle), math.sin(angle)


@njit(cache=True, nogil=True)
def squares_off(x: Floats, y: Floats, values: Floats) -> float:
    """Return the sum of squared deviations of points from a polyline."""
    squares = 0.0
    for i in range(len(x)):
        left, b = hats(x[i], len(values))
        squares += (y[i] - (1.0 - b) * values[left] - b * values[left + 1]) ** 2
    return squares


@njit(cache=True, nogil=True)
def fit_disparity(x: Floats, d: Floats, count: int, steepest: float, tolerance_m: float) -> Floats:
    """Return the robust profile (count,) of disparity d at x in [0, 1]: a line, then reweighted."""
    at_0, slope = best_line(x, d, steepest, 60, tolerance_m)
    line = np.zeros(count)
    for k in range(count):
        line[k] = max(at_0 + slope * k / (count - 1), 1e-3)
    values = line.copy()
    weight = np.zeros(len(x))
    for _ in range(6):
        for i in range(len(x)):
            left, b = hats(x[i], count)
            fit = (1.0 - b) * values[left] + b * values[left + 1]
            r = abs(d[i] - fit) / (tolerance_m * max(fit, 0.8) ** 2)
            weight[i] = (1.0 - r * r) ** 2 if r < 1.0 else 0.0
        values = fit_hats(x, d, weight, count, 0.1, line, 0.01)
    return values


@njit(cache=True, nogil=True)
def reached(x: Floats, d: Floats, values: Floats, tolerance_m: float) -> tuple[int, float, float]:
    """Return how many points lie on a profile, and the first and last place of them."""
    inliers, first, last = 0, 2.0, -1.0
    for i in range(len(x)):
        left, b = hats(x[i], len(values))
        fit = (1.0 - b) * values[left] + b * values[left + 1]
        if abs(d[i] - fit) <= tolerance_m * max(fit, 0.8) ** 2:
            inliers += 1
            first, last = min(first, x[i]), max(last, x[i])
    return inliers, first, last


@njit(cache=True, nogil=True)
def fit_region(
    u: Floats,
    v: Floats,
    z: Floats,
    f_px: float,
    knot_px: float,
    max_knots: int,
    tolerance_m: float,
    min_valid: float,
) -> tuple[int, Floats, Floats]:
    """Fit one region of N pixels (u, v) with depth z (NaN where there is none).

    Returns the number of knots (0: too little depth), rows (u, v, disparity) per knot, quality.
    """
    n = len(u)
    knots = np.zeros((MAX_KNOTS, 3))
    quality = np.zeros(QUALITY)
    if n == 0:
        return 0, knots, quality
    mu, mv, au, av = principal_axis(u, v)
    s = (u - mu) * au + (v - mv) * av
    q = (v - mv) * au - (u - mu) * av
    low, high = s.min(), s.max()
    span = max(high - low, 1.0)
    count = min(max(int(span / knot_px + 0.5) + 1, 2), max_knots)
    x = (s - low) / span
    lateral = fit_hats(x, q, np.ones(n), count, 0.2, np.zeros(count), 0.002)
    spread = squares_off(x, q, lateral)
    width = n / (span + 1.0)
    good, valid = np.isfinite(z), int(np.isfinite(z).sum())
    quality[0], quality[1], quality[2] = n, span + 1.0, width
    quality[3], quality[5] = valid / n, math.sqrt(spread / n) / width
    if valid < 3 or valid < min_valid * n:
        return 0, knots, quality
    xd, d = x[good], 1.0 / z[good]
    steepest = 4.0 * float(np.median(d)) / f_px * span
    values = fit_disparity(xd, d, count, steepest, tolerance_m)
    inliers, first, last = reached(xd, d, values, tolerance_m)
    quality[4] = inliers / valid
    if inliers < 3 or values.min() <= 0.05:
        return 0, knots, quality
    for k in range(count):
        at = first + (last - first) * k / (count - 1)
        left, b = hats(at, count)
        here = low + at * span
        side = (1.0 - b) * lateral[left] + b * lateral[left + 1]
        knots[k, 0] = mu + here * au - side * av
        knots[k, 1] = mv + here * av + side * au
        knots[k, 2] = (1.0 - b) * values[left] + b * values[left + 1]
    return count, knots, quality


@njit(cache=True, nogil=True)
def fit_regions(
    u: Floats,
    v: Floats,
    z: Floats,
    start: Ints,
    f_px: float,
    knot_px: float,
    max_knots: int,
    tolerance_m: float,
    min_valid: float,
) -> tuple[Ints, Floats, Floats]:
    """Fit R regions; region i holds the pixels start[i] up to start[i + 1].

    Returns knots per region (R,), rows (R, MAX_KNOTS, 3) of (u, v, disparity), quality (R, Q).
    """
    regions = len(start) - 1
    counts = np.zeros(regions, dtype=np.int64)
    knots = np.zeros((regions, MAX_KNOTS, 3))
    quality = np.zeros((regions, QUALITY))
    for i in range(regions):
        a, b = start[i], start[i + 1]
        counts[i], knots[i], quality[i] = fit_region(
            u[a:b], v[a:b], z[a:b], f_px, knot_px, max_knots, tolerance_m, min_valid
        )
    return counts, knots, quality


@njit(cache=True, nogil=True)
def shift_away(points: Floats, counts: Ints, shift_m: Floats) -> None:
    """Move the knots (R, MAX_KNOTS, 3) of R lines, the first counts[i] of each, away from the eye.

    By shift_m (R,), along the part of the ray across the line; not where that is next to nothing.
    """
    for i in range(len(counts)):
        line = points[i, : counts[i]].copy()
        for k in range(counts[i]):
            along = line[min(k + 1, counts[i] - 1)] - line[max(k - 1, 0)]
            along /= max(math.sqrt((along * along).sum()), 1e-12)
            ray = line[k] / math.sqrt((line[k] * line[k]).sum())
            across = ray - (ray * along).sum() * along
            norm = math.sqrt((across * across).sum())
            if norm > 0.05:
                points[i, k] += shift_m[i] / norm * across


@njit(cache=True, nogil=True)
def sample_lines(knots: Floats, start: Ints, step_m: float) -> tuple[Floats, Floats, Ints]:
    """Return points at most `step_m` apart along lines, unit directions, the line of each.

    Line i has the knots (N, 3) start[i] up to start[i + 1]; one of no length has no points.
    """
    length = np.zeros(len(knots))
    total = 0
    counts = np.zeros(len(start) - 1, dtype=np.int64)
    for i in range(len(counts)):
        way = 0.0
        for k in range(start[i], start[i + 1] - 1):
            step = knots[k + 1] - knots[k]
            length[k] = math.sqrt((step * step).sum())
            way += length[k]
        if way >= 1e-6:
            counts[i] = max(2, math.ceil(way / step_m) + 1)
        total += counts[i]
    points, directions = np.zeros((total, 3)), np.zeros((total, 3))
    of, n = np.zeros(total, dtype=np.int64), 0
    for i in range(len(counts)):
        way = length[start[i] : start[i + 1] - 1].sum()
        k, before = start[i], 0.0
        for j in range(counts[i]):
            at = way * j / (counts[i] - 1)
            while k < start[i + 1] - 2 and at >= before + length[k]:
                before += length[k]
                k += 1
            unit = (knots[k + 1] - knots[k]) / max(length[k], 1e-12)
            points[n], directions[n], of[n] = knots[k] + (at - before) * unit, unit, i
            n += 1
    return points, directions, of
