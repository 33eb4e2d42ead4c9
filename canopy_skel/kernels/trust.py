"""Which pixels of masks have depth that follows a robust profile along the mask.

All masks of a view lie one after the other: pixels of mask i are start[i] up to start[i + 1].
"""

import math

import numpy as np
from numpy.typing import NDArray

from canopy_skel.kernels.compiled import inner, kernel
from canopy_skel.kernels.median import median_of

Bools = NDArray[np.bool_]
Float32s = NDArray[np.float32]
Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

ROUNDS = 6
"""Of reweighted least squares."""


@inner("boolean(boolean[::1], int64[::1], int64, int64, int64)")
def is_inner(mask: Bools, box: Ints, v: int, u: int, margin: int) -> bool:
    """Say whether all pixels of a mask (h * w,) within `margin` of row v, column u are in it."""
    height, width = box[2], box[3]
    if v < margin or u < margin or v + margin >= height or u + margin >= width:
        return False
    for y in range(v - margin, v + margin + 1):
        for x in range(u - margin, u + margin + 1):
            if not mask[y * width + x]:
                return False
    return True


@kernel(
    "Tuple((float64[:,::1], int64[::1], int64[::1]))(boolean[::1], int64[:,::1],"
    " Array(float32, 2, 'C', readonly=True), int64, float64, float64, float64)"
)
def pixels_of(
    masks: Bools,
    boxes: Ints,
    depth_m: Float32s,
    margin: int,
    min_share: float,
    nearest_m: float,
    farthest_m: float,
) -> tuple[Floats, Ints, Ints]:
    """Shave `margin` pixels off masks; return (N, 3) u, v and depth of what has usable depth.

    `masks`: their boxes (M, 4) of left, top, height and width, one after the other. Those of which
    less than `min_share` would be left stay as they are. Also returns where each mask starts and
    how many pixels it has with and without usable depth.
    """
    room = 0
    for i in range(len(masks)):
        room += masks[i]
    pixels, start = np.empty((room, 3)), np.zeros(len(boxes) + 1, dtype=np.int64)
    sizes = np.zeros(len(boxes), dtype=np.int64)
    inner = np.empty(len(masks), dtype=np.bool_)
    at = count = 0
    for i in range(len(boxes)):
        left, top, height, width = boxes[i]
        mask = masks[at : at + height * width]
        whole = kept = 0
        for n in range(height * width):
            inner[n] = mask[n] and is_inner(mask, boxes[i], n // width, n % width, margin)
            whole += mask[n]
            kept += inner[n]
        shaved = kept >= min_share * whole
        sizes[i] = kept if shaved else whole
        for n in range(height * width):
            if inner[n] if shaved else mask[n]:
                u, v = left + n % width, top + n // width
                z = float(depth_m[v, u])
                if nearest_m <= z <= farthest_m:
                    pixels[count, 0], pixels[count, 1], pixels[count, 2] = u, v, z
                    count += 1
        at += height * width
        start[i + 1] = count
    return pixels[:count].copy(), start, sizes


@inner("float64(float64, float64)")
def tolerance_at(disparity: float, tolerance_m: float) -> float:
    """Return what a tolerance in depth is in disparity (1/m); constant beyond 1.25 m."""
    near = max(disparity, 0.8)
    return tolerance_m * near * near


@inner("void(float64[:,::1], int64, int64, float64[::1])")
def places_along(pixels: Floats, first: int, end: int, along: Floats) -> None:
    """Write where pixels (u, v) lie along the axis of largest spread, from -1 to 1."""
    mu = mv = uu = uv = vv = 0.0
    for n in range(first, end):
        mu, mv = mu + pixels[n, 0], mv + pixels[n, 1]
    mu, mv = mu / (end - first), mv / (end - first)
    for n in range(first, end):
        u, v = pixels[n, 0] - mu, pixels[n, 1] - mv
        uu, uv, vv = uu + u * u, uv + u * v, vv + v * v
    angle = 0.5 * math.atan2(2.0 * uv, uu - vv)
    au, av, longest = math.cos(angle), math.sin(angle), 1e-12
    for n in range(first, end):
        along[n - first] = (pixels[n, 0] - mu) * au + (pixels[n, 1] - mv) * av
        longest = max(longest, abs(along[n - first]))
    for n in range(end - first):
        along[n] /= longest


@inner(
    "UniTuple(float64, 2)(float64[::1], float64[::1], int64[:,::1], float64)", error_model="numpy"
)
def best_line(
    along: Floats, disparity: Floats, draws: Ints, tolerance_m: float
) -> tuple[float, float]:
    """Return the level and slope of the line through two pixels that all others agree with best.

    Misfits count up to the tolerance. Draws (D, 2) are below 2^32, for any number of pixels.
    """
    middle, lines = median_of(disparity.copy()), 0
    level, slope = np.empty(len(draws)), np.empty(len(draws))
    for draw in range(len(draws)):
        i, j = draws[draw, 0] * len(along) >> 32, draws[draw, 1] * len(along) >> 32
        run = along[j] - along[i]
        if abs(run) > 0.3:
            slope[lines] = (disparity[j] - disparity[i]) / run
            level[lines] = disparity[i] - slope[lines] * along[i]
            lines += 1
    if lines == 0:
        return middle, 0.0
    tolerance = tolerance_at(middle, tolerance_m)
    # Over the lines inside: that makes vector instructions and leaves the order of sums alone.
    levels, slopes, misfit = level[:lines], slope[:lines], np.zeros(lines)
    for n in range(len(along)):
        x, d = along[n], disparity[n]
        for line in range(lines):
            off = abs(d - (levels[line] + slopes[line] * x))
            misfit[line] += off if off < tolerance else tolerance
    best = 0
    for line in range(1, lines):
        if misfit[line] < misfit[best]:
            best = line
    return levels[best], slopes[best]


@inner("UniTuple(float64, 3)(float64[::1], float64)", error_model="numpy")
def parabola_of(sums: Floats, pull: float) -> tuple[float, float, float]:
    """Solve the normal equations of a parabola, with a slight pull towards 0 on all three.

    sums: of w, w x, w x^2, w x^3, w x^4, w d, w x d, w x^2 d.
    """
    a, b, c, d, e = sums[0] + pull, sums[1], sums[2], sums[2] + pull, sums[3]
    ba, ca = b / a, c / a
    d -= ba * b
    e -= ba * c
    f = sums[4] + pull - ca * c
    right_1, right_2 = sums[6] - ba * sums[5], sums[7] - ca * sums[5]
    ed = e / d
    bent = (right_2 - ed * right_1) / (f - ed * e)
    slope = (right_1 - e * bent) / d
    return (sums[5] - b * slope - c * bent) / a, slope, bent


@inner(
    "UniTuple(float64, 3)(float64[::1], float64[::1], UniTuple(float64, 3), float64)",
    error_model="numpy",
)
def reweighted(
    along: Floats, disparity: Floats, profile: tuple[float, float, float], tolerance_m: float
) -> tuple[float, float, float]:
    """Return the parabola through the pixels by how far each is from the last one (Tukey)."""
    sums = np.zeros(8)
    w0 = w1 = w2 = w3 = w4 = d0 = d1 = d2 = 0.0
    for n in range(len(along)):
        x, d = along[n], disparity[n]
        fit = profile[0] + x * (profile[1] + x * profile[2])
        off = (d - fit) / tolerance_at(fit, tolerance_m)
        inside = max(1.0 - off * off, 0.0)
        w = inside * inside
        w0, d0, w = w0 + w, d0 + w * d, w * x
        w1, d1, w = w1 + w, d1 + w * d, w * x
        w2, d2, w = w2 + w, d2 + w * d, w * x
        w3, w4 = w3 + w, w4 + w * x
    sums[0], sums[1], sums[2], sums[3], sums[4] = w0, w1, w2, w3, w4
    sums[5], sums[6], sums[7] = d0, d1, d2
    # The pull keeps the fit defined where few points agree.
    return parabola_of(sums, 1e-6 * len(along))


@kernel("boolean[::1](float64[:,::1], int64[::1], int64[:,::1], float64, int64)")
def follow_profiles(
    pixels: Floats, start: Ints, draws: Ints, tolerance_m: float, min_points: int
) -> Bools:
    """Say which pixels (N, 3) of u, v and depth lie on the robust profile of their mask.

    Masks of fewer than `min_points` have none: all their pixels pass.
    """
    follows = np.ones(len(pixels), dtype=np.bool_)
    for i in range(len(start) - 1):
        first, end = start[i], start[i + 1]
        if end - first < max(min_points, 1):
            continue
        along, disparity = np.empty(end - first), np.empty(end - first)
        places_along(pixels, first, end, along)
        for n in range(first, end):
            disparity[n - first] = 1.0 / pixels[n, 2]
        level, slope = best_line(along, disparity, draws, tolerance_m)
        profile = (level, slope, 0.0)
        for _ in range(ROUNDS):
            profile = reweighted(along, disparity, profile, tolerance_m)
        for n in range(end - first):
            fit = profile[0] + along[n] * (profile[1] + along[n] * profile[2])
            follows[first + n] = abs(disparity[n] - fit) <= tolerance_at(fit, tolerance_m)
    return follows
