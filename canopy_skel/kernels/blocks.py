"""Two-level voxel grids: a dense top table of 8^3 blocks, one slot per voxel of a block.

A slot is block * 512 + place in the block. Block 0 stands for all space that is not allocated.
"""

import numpy as np
from numba import njit
from numpy.typing import NDArray

Bytes = NDArray[np.uint8]
Ints = NDArray[np.int64]
Int32s = NDArray[np.int32]

SLOTS = 512
"""Voxels of a block."""
CENTRE = 13
"""Direction k = 9 (dx + 1) + 3 (dy + 1) + dz + 1 of a voxel to itself; 26 - k leads back."""
_BIAS = 1 << 20


def _moves() -> Int32s:
    """Return (512 * 27,): where direction k leads from a place: block direction << 9 | place."""
    place = np.indices((8, 8, 8)).reshape(3, 512, 1)
    step = (np.indices((3, 3, 3)) - 1).reshape(3, 1, 27)
    x, y, z = place + step
    block = ((x >> 3) + 1) * 9 + ((y >> 3) + 1) * 3 + (z >> 3) + 1
    return np.asarray(block << 9 | (x & 7) << 6 | (y & 7) << 3 | (z & 7), np.int32).ravel()


MOVES = _moves()


@njit("int64(int32[:,:,::1], int64[::1], int64, int64, int64)", cache=True, nogil=True)
def slot_of(top: Int32s, origin: Ints, x: int, y: int, z: int) -> int:
    """Return the slot of voxel (x, y, z), one of block 0 where nothing is allocated."""
    bx, by, bz = (x >> 3) - origin[0], (y >> 3) - origin[1], (z >> 3) - origin[2]
    if not (0 <= bx < top.shape[0] and 0 <= by < top.shape[1] and 0 <= bz < top.shape[2]):
        return 0
    return (int(top[bx, by, bz]) << 9) | ((x & 7) << 6) | ((y & 7) << 3) | (z & 7)


@njit("int64[::1](int32[:,:,::1], int64[::1], int32[:,::1])", cache=True, nogil=True)
def slots_of(top: Int32s, origin: Ints, voxels: Int32s) -> Ints:
    """Return the slots (N,) of (N, 3) voxels; below 512 where nothing is allocated."""
    slots = np.empty(len(voxels), dtype=np.int64)
    for i in range(len(voxels)):
        slots[i] = slot_of(top, origin, voxels[i, 0], voxels[i, 1], voxels[i, 2])
    return slots


@njit("int64[:,::1](int32[:,::1])", cache=True, nogil=True)
def bounds(rows: Int32s) -> Ints:
    """Return the first and the end block (2, 3) of rows (R, 4) of x, y, first z, end z."""
    span = np.empty((2, 3), dtype=np.int64)
    for i in range(3):
        span[0, i], span[1, i] = rows[0, i], rows[0, i]
    for r in range(len(rows)):
        for i in range(3):
            span[0, i] = min(span[0, i], rows[r, i])
            span[1, i] = max(span[1, i], rows[r, i])
        span[1, 2] = max(span[1, 2], rows[r, 3] - 1)
    for i in range(3):
        span[0, i], span[1, i] = span[0, i] >> 3, (span[1, i] >> 3) + 1
    return span


@njit("int64(int32[:,:,::1], int64[::1], int32[:,::1], int64)", cache=True, nogil=True)
def allocate(top: Int32s, origin: Ints, rows: Int32s, count: int) -> int:
    """Number the blocks that rows (R, 4) of x, y, first z, end z touch; return the new count."""
    for r in range(len(rows)):
        bx, by = (rows[r, 0] >> 3) - origin[0], (rows[r, 1] >> 3) - origin[1]
        for bz in range((rows[r, 2] >> 3) - origin[2], ((rows[r, 3] - 1) >> 3) - origin[2] + 1):
            if top[bx, by, bz] == 0:
                top[bx, by, bz] = count
                count += 1
    return count


@njit("void(int32[:,:,::1], int32[:,::1], int64[:,::1])", cache=True, nogil=True)
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


@njit("int64(int32[:,::1], int64, int64)", cache=True, nogil=True)
def beside(neighbours: Int32s, slot: int, k: int) -> int:
    """Return the slot in direction k of a slot."""
    move = MOVES[(slot & 511) * 27 + k]
    return int((int(neighbours[slot >> 9, move >> 9]) << 9) | (move & 511))


@njit("int64(int32[:,::1], int64)", cache=True, nogil=True)
def key_of(places: Int32s, slot: int) -> int:
    """Return a number that orders slots as their voxels (x, y, z), whatever block they are in.

    `places` (B, 3) are the blocks' coordinates; within 2^20 voxels of block 1, farther than any
    top table reaches.
    """
    block = slot >> 9
    x = ((places[block, 0] - places[1, 0]) << 3) + ((slot >> 6) & 7) + _BIAS
    y = ((places[block, 1] - places[1, 1]) << 3) + ((slot >> 3) & 7) + _BIAS
    z = ((places[block, 2] - places[1, 2]) << 3) + (slot & 7) + _BIAS
    return (int(x) << 42) | (int(y) << 21) | int(z)


@njit("int32[:,::1](int32[:,::1], int32[:,:,::1], int64[::1])", cache=True, nogil=True)
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


@njit(
    "int64(int32[:,:,::1], int64[::1], int32[:,::1], int64, int64, int64)", cache=True, nogil=True
)
def find(top: Int32s, origin: Ints, slots: Int32s, x: int, y: int, z: int) -> int:
    """Return the place of voxel (x, y, z) in the list, or -1."""
    bx, by, bz = (x >> 3) - origin[0], (y >> 3) - origin[1], (z >> 3) - origin[2]
    if not (0 <= bx < top.shape[0] and 0 <= by < top.shape[1] and 0 <= bz < top.shape[2]):
        return -1
    block = top[bx, by, bz]
    if block < 0:
        return -1
    return int(slots[block, ((x & 7) << 6) | ((y & 7) << 3) | (z & 7)])


@njit("int32[::1](int32[:,:,::1], int64[::1], int32[:,::1], int32[:,::1])", cache=True, nogil=True)
def find_all(top: Int32s, origin: Ints, slots: Int32s, voxels: Int32s) -> Int32s:
    """Return the places (N,) of (N, 3) voxels, -1 where a voxel is not in the list."""
    found = np.empty(len(voxels), dtype=np.int32)
    for i in range(len(voxels)):
        found[i] = find(top, origin, slots, voxels[i, 0], voxels[i, 1], voxels[i, 2])
    return found
