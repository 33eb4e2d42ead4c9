"""Where a voxel is in a two-level grid: a dense top table of blocks, a slot per voxel of these."""

import numpy as np
from numpy.typing import NDArray

from canopy_skel.kernels.compiled import inner

Ints = NDArray[np.int64]
Int32s = NDArray[np.int32]

SLOTS = 512
"""Voxels of a block."""
CENTRE = 13
"""Direction k = 9 (dx + 1) + 3 (dy + 1) + dz + 1 of a voxel to itself; 26 - k leads back."""
RUN = 8
"""Voxels of a run: a row along z in one block, slots 8 run to 8 run + 7."""


@inner("int64(int32[:,:,::1], int64[::1], int64, int64, int64)")
def slot_of(top: Int32s, origin: Ints, x: int, y: int, z: int) -> int:
    """Return the slot of voxel (x, y, z), one of block 0 where nothing is allocated."""
    bx, by, bz = (x >> 3) - origin[0], (y >> 3) - origin[1], (z >> 3) - origin[2]
    if not (0 <= bx < top.shape[0] and 0 <= by < top.shape[1] and 0 <= bz < top.shape[2]):
        return 0
    return (int(top[bx, by, bz]) << 9) | ((x & 7) << 6) | ((y & 7) << 3) | (z & 7)


@inner("int64(int32[:,:,::1], int64[::1], int32[:,::1], int64, int64, int64)")
def find(top: Int32s, origin: Ints, slots: Int32s, x: int, y: int, z: int) -> int:
    """Return the place of voxel (x, y, z) in the list, or -1."""
    bx, by, bz = (x >> 3) - origin[0], (y >> 3) - origin[1], (z >> 3) - origin[2]
    if not (0 <= bx < top.shape[0] and 0 <= by < top.shape[1] and 0 <= bz < top.shape[2]):
        return -1
    block = top[bx, by, bz]
    if block < 0:
        return -1
    return int(slots[block, ((x & 7) << 6) | ((y & 7) << 3) | (z & 7)])
