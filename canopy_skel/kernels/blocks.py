"""Find voxels in a two-level grid: a dense top table of 8^3 blocks, one slot per voxel."""

import numpy as np
from numba import njit
from numpy.typing import NDArray

Ints = NDArray[np.int64]
Int32s = NDArray[np.int32]


@njit(cache=True, nogil=True)
def index_voxels(voxels: Int32s, top: Int32s, origin: Ints) -> Int32s:
    """Fill `top` (all -1) and return slots (B, 512): the place of each voxel in the list, or -1."""
    count = 0
    for i in range(len(voxels)):
        b = (voxels[i] >> 3) - origin
        if top[b[0], b[1], b[2]] < 0:
            top[b[0], b[1], b[2]] = count
            count += 1
    slots = np.full((count, 512), -1, dtype=np.int32)
    for i in range(len(voxels)):
        b = (voxels[i] >> 3) - origin
        x, y, z = voxels[i] & 7
        slots[top[b[0], b[1], b[2]], (x << 6) | (y << 3) | z] = i
    return slots


@njit(cache=True, nogil=True)
def find(top: Int32s, origin: Ints, slots: Int32s, x: int, y: int, z: int) -> int:
    """Return the place of voxel (x, y, z) in the list, or -1."""
    bx, by, bz = (x >> 3) - origin[0], (y >> 3) - origin[1], (z >> 3) - origin[2]
    if not (0 <= bx < top.shape[0] and 0 <= by < top.shape[1] and 0 <= bz < top.shape[2]):
        return -1
    block = top[bx, by, bz]
    if block < 0:
        return -1
    return int(slots[block, ((x & 7) << 6) | ((y & 7) << 3) | (z & 7)])


@njit(cache=True, nogil=True)
def find_all(top: Int32s, origin: Ints, slots: Int32s, voxels: Int32s) -> Int32s:
    """Return the places (N,) of (N, 3) voxels, -1 where a voxel is not in the list."""
    found = np.full(len(voxels), -1, dtype=np.int32)
    for i in range(len(voxels)):
        found[i] = find(top, origin, slots, voxels[i, 0], voxels[i, 1], voxels[i, 2])
    return found
