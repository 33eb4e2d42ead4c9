"""Which places a free end might be joined to."""

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


@njit(cache=True, nogil=True)
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
    found = 0
    ends = np.zeros(len(end_points) * most, dtype=np.int64)
    vertices = np.zeros(len(end_points) * most, dtype=np.int64)
    others = np.zeros(len(end_points) * most, dtype=np.int64)
    ranks = np.zeros(len(end_points) * most)
    best = np.full((components, 2), np.inf)
    best_vertex = np.zeros((components, 2), dtype=np.int64)
    best_other = np.zeros((components, 2), dtype=np.int64)
    touched = np.zeros(components, dtype=np.int64)
    for i in range(len(end_points)):
        count = 0
        for j in range(len(points)):
            c = component[j]
            if c == end_component[i]:
                continue
            gx = points[j, 0] - end_points[i, 0]
            gy = points[j, 1] - end_points[i, 1]
            gz = points[j, 2] - end_points[i, 2]
            squared = gx * gx + gy * gy + gz * gz
            if squared > reach_m * reach_m:
                continue
            gap = max(math.sqrt(squared), 1e-9)
            ax, ay, az = end_tangents[i]
            cos_a = (ax * gx + ay * gy + az * gz) / gap
            if cos_a < -0.5 and gap > 0.03:
                continue
            if not (best[c, 0] < np.inf or best[c, 1] < np.inf):
                touched[count] = c
                count += 1
            kind, other, turn = 1, -1, 0.4
            for side in range(2):
                e = vertex_end[j, side]
                if e >= 0:
                    bx, by, bz = end_tangents[e]
                    cost = 0.5 * (1.0 + (bx * gx + by * gy + bz * gz) / gap)
                    if other < 0 or cost < turn:
                        kind, other, turn = 0, e, cost
            score = gap * (1.0 + 1.5 * (1.0 - cos_a) + turn)
            if score < best[c, kind]:
                best[c, kind], best_vertex[c, kind], best_other[c, kind] = score, j, other
        taken = 0
        while taken < most:
            low, low_c, low_kind = np.inf, -1, 0
            for t in range(count):
                for kind in range(2):
                    if best[touched[t], kind] < low:
                        low, low_c, low_kind = best[touched[t], kind], touched[t], kind
            if low_c < 0:
                break
            ends[found], vertices[found] = i, best_vertex[low_c, low_kind]
            others[found], ranks[found] = best_other[low_c, low_kind], low
            best[low_c, low_kind] = np.inf
            found += 1
            taken += 1
        for t in range(count):
            best[touched[t], 0] = np.inf
            best[touched[t], 1] = np.inf
    return ends[:found], vertices[:found], others[:found], ranks[:found]
