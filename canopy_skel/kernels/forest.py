"""Spanning forests over voxels, and the dead ends to cut off them."""

import math

import numpy as np
from numpy.typing import NDArray

from canopy_skel.kernels.compiled import inner, kernel
from canopy_skel.kernels.grid import CENTRE, find

Bytes = NDArray[np.uint8]
Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Int32s = NDArray[np.int32]


@kernel(
    "Tuple((int64[:,::1], float64[::1]))(float64[:,::1], int32[:,::1], int32[:,:,::1], int64[::1],"
    " int32[:,::1])"
)
def neighbour_pairs(
    points: Floats, voxels: Int32s, top: Int32s, origin: Ints, slots: Int32s
) -> tuple[Ints, Floats]:
    """Return pairs (E, 2) of points, one per voxel, in neighbouring voxels, and their distances."""
    pairs = np.empty((CENTRE * len(points), 2), dtype=np.int64)
    length = np.empty(CENTRE * len(points))
    count = 0
    for a in range(len(points)):
        x, y, z = voxels[a, 0], voxels[a, 1], voxels[a, 2]
        for k in range(CENTRE + 1, 27):
            b = find(top, origin, slots, x + k // 9 - 1, y + k // 3 % 3 - 1, z + k % 3 - 1)
            if b >= 0:
                squared = 0.0
                for i in range(3):
                    squared += (points[a, i] - points[b, i]) ** 2
                pairs[count, 0], pairs[count, 1] = a, b
                length[count] = math.sqrt(squared)
                count += 1
    return pairs[:count].copy(), length[:count].copy()


@inner("int64(int64, int64, int64[::1], int64[::1], uint8[::1])")
def onward(vertex: int, came_from: int, start: Ints, beside: Ints, alive: Bytes) -> int:
    """Return the living neighbour of a vertex other than the one it was come from, or -1."""
    for i in range(start[vertex], start[vertex + 1]):
        if beside[i] != came_from and alive[beside[i]]:
            return int(beside[i])
    return -1


@kernel(
    "Tuple((int64[:,::1], float64[::1]))(float64[:,::1], int64[::1], int64[::1], int64[::1],"
    " uint8[::1], float64)"
)
def spurs(
    points: Floats, start: Ints, beside: Ints, degree: Ints, alive: Bytes, longest_m: float
) -> tuple[Ints, Floats]:
    """Return (tip, fork) of all dead ends no longer than `longest_m`, and their lengths."""
    found, length = np.empty((len(points), 2), dtype=np.int64), np.empty(len(points))
    count = 0
    for tip in range(len(points)):
        if not alive[tip] or degree[tip] != 1:
            continue
        before, at, total = -1, tip, 0.0
        while at >= 0 and degree[at] < 3 and total <= longest_m:
            before, at = at, onward(at, before, start, beside, alive)
            if at >= 0:
                squared = 0.0
                for i in range(3):
                    squared += (points[at, i] - points[before, i]) ** 2
                total += math.sqrt(squared)
        if at >= 0 and total <= longest_m:
            found[count, 0], found[count, 1], length[count] = tip, at, total
            count += 1
    return found[:count].copy(), length[:count].copy()


@kernel("int64(int64[:,::1], int64[::1], int64[::1], int64[::1], uint8[::1])")
def cut(found: Ints, start: Ints, beside: Ints, degree: Ints, alive: Bytes) -> int:
    """Cut spurs (sorted) off forks that still are forks; return how many were."""
    done = 0
    for i in range(len(found)):
        before, at, fork = -1, found[i, 0], found[i, 1]
        if degree[fork] < 3:
            continue
        while at != fork:
            before, at = at, onward(at, before, start, beside, alive)
            alive[before] = 0
        degree[fork] -= 1
        done += 1
    return done
