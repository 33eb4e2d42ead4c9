"""Two-level voxel grids: a dense top table of 8^3 blocks, one slot per voxel of a block.

A slot is block * 512 + place in the block. Block 0 stands for all space that is not allocated.
"""

import numpy as np
from numpy.typing import NDArray

from canopy_skel.kernels.compiled import kernel
from canopy_skel.kernels.grid import SLOTS, find, slot_of

Bytes = NDArray[np.uint8]
Ints = NDArray[np.int64]
Int32s = NDArray[np.int32]


@kernel("int64[::1](int32[:,:,::1], int64[::1], int32[:,::1])")
def slots_of(top: Int32s, origin: Ints, voxels: Int32s) -> Ints:
    """Return the slots (N,) of (N, 3) voxels; below 512 where nothing is allocated."""
    slots = np.empty(len(voxels), dtype=np.int64)
    for i in range(len(voxels)):
        slots[i] = slot_of(top, origin, voxels[i, 0], voxels[i, 1], voxels[i, 2])
    return slots


@kernel("void(int32[:,:,::1], int32[:,::1], int64[:,::1])")
def connect(top: Int32s, neighbours: Int32s, fresh: Ints) -> None:
    """Enter new blocks at (F, 3) places of the top table as neighbours (B, 27), both ways."""
    for x, y, z in fresh:
        block = top[x, y, z]
        for k in range(27):
            i, j, m = x + k // 9 - 1, y + k // 3 % 3 - 1, z + k % 3 - 1
            if 0 <= i < top.shape[0] and 0 <= j < top.shape[1] and 0 <= m < top.shape[2]:
                other = top[i, j, m]
                if other > 0:
                    neighbours[block, k] = other
                    neighbours[other, 26 - k] = block


@kernel("int32[:,::1](int32[:,::1], int32[:,:,::1], int64[::1])")
def index_voxels(voxels: Int32s, top: Int32s, origin: Ints) -> Int32s:
    """Fill `top` (all -1) and return slots (B, 512): the place of each voxel in the list, or -1."""
    count = 0
    for x, y, z in voxels:
        bx, by, bz = (x >> 3) - origin[0], (y >> 3) - origin[1], (z >> 3) - origin[2]
        if top[bx, by, bz] < 0:
            top[bx, by, bz] = count
            count += 1
    slots = np.empty((count, SLOTS), dtype=np.int32)
    for b in range(count):
        for i in range(SLOTS):
            slots[b, i] = -1
    for i in range(len(voxels)):
        x, y, z = voxels[i, 0], voxels[i, 1], voxels[i, 2]
        b = top[(x >> 3) - origin[0], (y >> 3) - origin[1], (z >> 3) - origin[2]]
        slots[b, (x & 7) << 6 | (y & 7) << 3 | (z & 7)] = i
    return slots


@kernel("int32[::1](int32[:,:,::1], int64[::1], int32[:,::1], int32[:,::1])")
def find_all(top: Int32s, origin: Ints, slots: Int32s, voxels: Int32s) -> Int32s:
    """Return the places (N,) of (N, 3) voxels, -1 where a voxel is not in the list."""
    found = np.empty(len(voxels), dtype=np.int32)
    for i in range(len(voxels)):
        found[i] = find(top, origin, slots, voxels[i, 0], voxels[i, 1], voxels[i, 2])
    return found
