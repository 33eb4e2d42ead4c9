"""Draw points of many views onto the curve they lie on, and sum up what stands behind each."""

import math

import numpy as np
from numpy.typing import NDArray

from canopy_skel.kernels.across import draw
from canopy_skel.kernels.cells import cell_key, most_rows, no_box, rows_around
from canopy_skel.kernels.compiled import inner, kernel

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
SUPPORT = 7
"""Columns: total weight, radius, mean p, largest p, views, share of weight from instances, probable
radius."""


@kernel("int64[::1](float64[:,::1], float64)")
def cell_keys(points: Floats, cell_m: float) -> Ints:
    """Return the number of the cell that each of (N, 3) points lies in."""
    keys = np.zeros(len(points), dtype=np.int64)
    for i in range(len(points)):
        x, y = math.floor(points[i, 0] / cell_m), math.floor(points[i, 1] / cell_m)
        keys[i] = cell_key(x, y, math.floor(points[i, 2] / cell_m))
    return keys


@inner(
    "int64(float64, float64, float64, float64, float64[:,::1], int64[::1], float64, int64[::1],"
    " int64[:,::1], int64[::1], float64[::1])"
)
def near(
    px: float,
    py: float,
    pz: float,
    reach_m: float,
    references: Floats,
    keys: Ints,
    cell_m: float,
    box: Ints,
    rows: Ints,
    found: Ints,
    squared: Floats,
) -> int:
    """Write which references (R, 3), sorted by `keys` of their cells, lie within reach; how many.

    Also writes the squares of their distances. `box` and `rows`: see `rows_around`.
    """
    count = 0
    for row in range(rows_around(px, py, pz, reach_m, cell_m, keys, box, rows)):
        for j in range(rows[row, 0], rows[row, 1]):
            wx, wy, wz = references[j, 0] - px, references[j, 1] - py, references[j, 2] - pz
            # Written always and counted at times: no branch to guess wrong.
            found[count], squared[count] = j, wx * wx + wy * wy + wz * wz
            count += squared[count] <= reach_m * reach_m
    return count


@inner(
    "int64(float64[::1], float64[:,::1], float64, float64[::1], float64, int64, int64[::1],"
    " float64[::1], float64[::1])"
)
def weigh_along(
    direction: Floats,
    directions: Floats,
    min_cosine: float,
    weights: Floats,
    width: float,
    count: int,
    found: Ints,
    squared: Floats,
    cosines: Floats,
) -> int:
    """Keep of what was found that which runs along a direction, write its cosines; how many.

    Their squared distances become their weights.
    """
    kept, dx, dy, dz = 0, direction[0], direction[1], direction[2]
    for n in range(count):
        j = found[n]
        cosine = dx * directions[j, 0] + dy * directions[j, 1] + dz * directions[j, 2]
        found[kept], squared[kept], cosines[kept] = j, squared[n], cosine
        kept += abs(cosine) >= min_cosine
    # By themselves: a call among sums would put all of them aside.
    for n in range(kept):
        squared[n] = weights[found[n]] * math.exp(-0.5 * squared[n] / (width * width))
    return kept


@inner("float64(float64[::1], float64, float64)")
def widest(radii: Floats, bandwidth_m: float, radius_share: float) -> float:
    """Return the largest bandwidth of any point."""
    width = bandwidth_m
    for i in range(len(radii)):
        width = max(width, radius_share * radii[i])
    return width


@inner("int64(int64)")
def bits_in(number: int) -> int:
    """Return how many bits of a number are set."""
    count = 0
    while number:
        number &= number - 1
        count += 1
    return count


@kernel(
    "UniTuple(float64[:,::1], 3)(float64[:,::1], float64[:,::1], float64[::1], float64[:,::1],"
    " float64[:,::1], float64[::1], float64[::1], float64[::1], float64[::1], int64[::1],"
    " boolean[::1], int64[::1], float64, float64, float64, float64)"
)
def shift_across(
    points: Floats,
    directions: Floats,
    radii: Floats,
    references: Floats,
    reference_directions: Floats,
    reference_radii: Floats,
    probable_radii: Floats,
    weights: Floats,
    probability: Floats,
    view_bits: Ints,
    fragment: NDArray[np.bool_],
    keys: Ints,
    cell_m: float,
    bandwidth_m: float,
    radius_share: float,
    min_cosine: float,
) -> tuple[Floats, Floats, Floats]:
    """Move points (P, 3) to the weighted mean of the references, across their direction only.

    References (R, 3) lie sorted by the `keys` of their cells of `cell_m`. The bandwidth is the
    larger of `bandwidth_m` and a share of the point's radius; references count within twice that
    and with |cos| of the angle between the directions of at least `min_cosine`. Returns the moved
    points, the mean directions, and the support (P, SUPPORT).
    """
    moved, turned = points.copy(), directions.copy()
    support, found = np.zeros((len(points), SUPPORT)), np.zeros(len(references) + 1, dtype=np.int64)
    squared, cosines = np.zeros(len(found)), np.zeros(len(found))
    reach_m = 2.0 * widest(radii, bandwidth_m, radius_share)
    box, rows = no_box(), np.zeros((most_rows(reach_m, cell_m), 2), dtype=np.int64)
    for i in range(len(points)):
        px, py, pz = points[i, 0], points[i, 1], points[i, 2]
        width = max(bandwidth_m, radius_share * radii[i])
        count = near(px, py, pz, 2.0 * width, references, keys, cell_m, box, rows, found, squared)
        count = weigh_along(
            directions[i], reference_directions, min_cosine, weights, width, count, found, squared,
            cosines,
        )  # fmt: skip
        total, bits = 0.0, 0
        ox = oy = oz = ex = ey = ez = r = probable_r = mean_p = masks = largest = 0.0
        for n in range(count):
            j, weight = found[n], squared[n]
            signed = weight if cosines[n] > 0.0 else -weight
            total, masks = total + weight, masks + (0.0 if fragment[j] else weight)
            ox, oy = ox + weight * (references[j, 0] - px), oy + weight * (references[j, 1] - py)
            oz = oz + weight * (references[j, 2] - pz)
            ex = ex + signed * reference_directions[j, 0]
            ey = ey + signed * reference_directions[j, 1]
            ez = ez + signed * reference_directions[j, 2]
            r, mean_p = r + weight * reference_radii[j], mean_p + weight * probability[j]
            probable_r = probable_r + weight * probable_radii[j]
            largest, bits = max(largest, probability[j]), bits | view_bits[j]
        if draw((ox, oy, oz), (ex, ey, ez), total, moved[i], turned[i]):
            support[i, 0], support[i, 1], support[i, 2] = total, r / total, mean_p / total
            support[i, 3], support[i, 4], support[i, 5] = largest, bits_in(bits), masks / total
            support[i, 6] = probable_r / total
    return moved, turned, support


@kernel(
    "float64[:,:,::1](int64[::1], float64[:,::1], float64[:,::1], float64[::1], int64[::1],"
    " float64, float64, float64)"
)
def spread_around(
    chosen: Ints,
    directions: Floats,
    references: Floats,
    weights: Floats,
    keys: Ints,
    cell_m: float,
    bandwidth_m: float,
    own_share: float,
) -> Floats:
    """Return how the references (R, 3) lie around some of them: covariances (C, 3, 3).

    References lie sorted by the `keys` of their cells of `cell_m` and count within twice the
    bandwidth, with Gaussian weights. `own_share` of the bandwidth squared is added along their own
    `directions` (R, 3).
    """
    spread, found = np.zeros((len(chosen), 3, 3)), np.zeros(len(references) + 1, dtype=np.int64)
    squared, reach_m = np.zeros(len(found)), 2 * bandwidth_m
    box, rows = no_box(), np.zeros((most_rows(reach_m, cell_m), 2), dtype=np.int64)
    own = own_share * bandwidth_m**2
    for c in range(len(chosen)):
        i = chosen[c]
        px, py, pz = references[i, 0], references[i, 1], references[i, 2]
        count = near(px, py, pz, reach_m, references, keys, cell_m, box, rows, found, squared)
        for n in range(count):
            squared[n] = weights[found[n]] * math.exp(-0.5 * squared[n] / bandwidth_m**2)
        total = mx = my = mz = xx = yx = yy = zx = zy = zz = 0.0
        for n in range(count):
            j, weight = found[n], squared[n]
            x, y, z = references[j, 0] - px, references[j, 1] - py, references[j, 2] - pz
            total, mx, my, mz = total + weight, mx + weight * x, my + weight * y, mz + weight * z
            xx, yx, yy = xx + weight * x * x, yx + weight * y * x, yy + weight * y * y
            zx, zy, zz = zx + weight * z * x, zy + weight * z * y, zz + weight * z * z
        dx, dy, dz = directions[i, 0], directions[i, 1], directions[i, 2]
        spread[c, 0, 0] = (xx - mx * mx / total) / total + own * dx * dx
        spread[c, 1, 1] = (yy - my * my / total) / total + own * dy * dy
        spread[c, 2, 2] = (zz - mz * mz / total) / total + own * dz * dz
        spread[c, 1, 0] = spread[c, 0, 1] = (yx - my * mx / total) / total + own * dy * dx
        spread[c, 2, 0] = spread[c, 0, 2] = (zx - mz * mx / total) / total + own * dz * dx
        spread[c, 2, 1] = spread[c, 1, 2] = (zy - mz * my / total) / total + own * dz * dy
    return spread


@kernel("boolean[::1](float64[:,::1], int64[::1], int64[::1], float64, float64)")
def thinned(
    points: Floats, order: Ints, keys: Ints, cell_m: float, spacing_m: float
) -> NDArray[np.bool_]:
    """Keep, in this order, each point (P, 3) that lies farther than the spacing from all kept.

    Points lie sorted by the `keys` of their cells of `cell_m`.
    """
    kept, covered = np.zeros(len(points), dtype=np.bool_), np.zeros(len(points), dtype=np.bool_)
    found, squared = np.zeros(len(points) + 1, dtype=np.int64), np.zeros(len(points) + 1)
    box, rows = no_box(), np.zeros((most_rows(spacing_m, cell_m), 2), dtype=np.int64)
    for i in order:
        if covered[i]:
            continue
        kept[i] = True
        px, py, pz = points[i, 0], points[i, 1], points[i, 2]
        count = near(px, py, pz, spacing_m, points, keys, cell_m, box, rows, found, squared)
        for n in range(count):
            covered[found[n]] = True
    return kept
