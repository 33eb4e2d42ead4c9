"""Which places a free end might be joined to."""

import math

import numpy as np
from numpy.typing import NDArray

from canopy_skel.kernels.compiled import inner, kernel

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


@inner(
    "Tuple((float64, int64, int64))(int64, int64, float64[:,::1], float64[:,::1], int64[:,::1],"
    " float64[:,::1], float64)"
)
def joint(
    end: int,
    vertex: int,
    end_points: Floats,
    end_tangents: Floats,
    vertex_end: Ints,
    points: Floats,
    reach_m: float,
) -> tuple[float, int, int]:
    """Return ranking, kind (0 end to end, 1 to a side) and other end (or -1) of a joint.

    The ranking is inf where the vertex is out of reach, or behind the end.
    """
    gx = points[vertex, 0] - end_points[end, 0]
    gy = points[vertex, 1] - end_points[end, 1]
    gz = points[vertex, 2] - end_points[end, 2]
    squared = gx * gx + gy * gy + gz * gz
    if squared > reach_m * reach_m:
        return math.inf, 1, -1
    gap = max(math.sqrt(squared), 1e-9)
    ax, ay, az = end_tangents[end, 0], end_tangents[end, 1], end_tangents[end, 2]
    cos_a = (ax * gx + ay * gy + az * gz) / gap
    if cos_a < -0.5 and gap > 0.03:
        return math.inf, 1, -1
    kind, other, turn = 1, -1, 0.4
    for side in range(2):
        e = vertex_end[vertex, side]
        if e >= 0:
            bx, by, bz = end_tangents[e, 0], end_tangents[e, 1], end_tangents[e, 2]
            cost = 0.5 * (1.0 + (bx * gx + by * gy + bz * gz) / gap)
            if other < 0 or cost < turn:
                kind, other, turn = 0, e, cost
    return gap * (1.0 + 1.5 * (1.0 - cos_a) + turn), kind, other


@inner("UniTuple(int64, 2)(float64[:,::1], int64[::1], int64)")
def least(best: Floats, chosen: Ints, count: int) -> tuple[int, int]:
    """Return row and column of the least entry in the first chosen rows, row -1 if all are inf."""
    low, row, column = math.inf, -1, 0
    for i in range(count):
        r = chosen[i]
        for kind in range(2):
            if best[r, kind] < low:
                low, row, column = best[r, kind], r, kind
    return row, column


@kernel(
    "Tuple((int64[::1], int64[::1], int64[::1], float64[::1]))(float64[:,::1], float64[:,::1],"
    " int64[::1], int64[:,::1], float64[:,::1], int64[::1], int64, float64, int64)"
)
def link_candidates(
    end_points: Floats,
    end_tangents: Floats,
    end_component: Ints,
    vertex_end: Ints,
    points: Floats,
    component: Ints,
    components: int,
    reach_m: float,
    most: int,
) -> tuple[Ints, Ints, Ints, Floats]:
    """Return (end, vertex, other end or -1, ranking) of the best joints of each end.

    Per other component the best end and the best other vertex stand as candidates, and of these
    the `most` with the least gap x (1 + 1.5 (1 - cos A) + 0.5 (1 - cos B)), 0.4 for the last term
    where the other vertex is no end. `vertex_end` (V, 2): the ends at each vertex, -1 for none.
    """
    found, room = 0, len(end_points) * most
    ends, vertices = np.zeros(room, dtype=np.int64), np.zeros(room, dtype=np.int64)
    others, ranks = np.zeros(room, dtype=np.int64), np.zeros(room)
    best = np.full((components, 2), math.inf)
    best_vertex = np.zeros((components, 2), dtype=np.int64)
    best_other = np.zeros((components, 2), dtype=np.int64)
    touched = np.zeros(components, dtype=np.int64)
    for i in range(len(end_points)):
        count = 0
        for j in range(len(points)):
            c = component[j]
            if c == end_component[i]:
                continue
            score, kind, other = joint(i, j, end_points, end_tangents, vertex_end, points, reach_m)
            if score == math.inf:
                continue
            if not (best[c, 0] < math.inf or best[c, 1] < math.inf):
                touched[count] = c
                count += 1
            if score < best[c, kind]:
                best[c, kind], best_vertex[c, kind], best_other[c, kind] = score, j, other
        for _ in range(most):
            c, kind = least(best, touched, count)
            if c < 0:
                break
            ends[found], vertices[found] = i, best_vertex[c, kind]
            others[found], ranks[found] = best_other[c, kind], best[c, kind]
            best[c, kind] = math.inf
            found += 1
        for n in range(count):
            best[touched[n], 0] = best[touched[n], 1] = math.inf
    return ends[:found], vertices[:found], others[:found], ranks[:found]
