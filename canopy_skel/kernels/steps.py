"""From a voxel to its 26 neighbours: which slots they have, and what a step costs."""

import math

import numpy as np
from numpy.typing import NDArray

from canopy_skel.kernels.compiled import inner

Ints = NDArray[np.int64]
Int32s = NDArray[np.int32]

UNITS_PER_NAT = 4096
UNREACHED = (1 << 31) - 1
_BIAS = 1 << 20


def _moves() -> Int32s:
    """Return (512 * 27,): where direction k leads from a place: block direction << 9 | place."""
    place = np.indices((8, 8, 8)).reshape(3, 512, 1)
    step = (np.indices((3, 3, 3)) - 1).reshape(3, 1, 27)
    x, y, z = place + step
    block = ((x >> 3) + 1) * 9 + ((y >> 3) + 1) * 3 + (z >> 3) + 1
    return np.asarray(block << 9 | (x & 7) << 6 | (y & 7) << 3 | (z & 7), np.int32).ravel()


def _costs() -> Int32s:
    """Return the cost of a step by the sum of its two levels (0 to 510)."""
    total = [0.0, *(-math.log(both / 510) * UNITS_PER_NAT for both in range(1, 511))]
    return np.round(total).astype(np.int32)


def _lengths() -> Int32s:
    """Return what the length of a step adds, by direction."""
    steps = np.abs(np.indices((3, 3, 3)) - 1).sum(axis=0).ravel()
    lengths: Int32s = np.array([0, 5, 7, 9], dtype=np.int32)[steps]
    return lengths


MOVES = _moves()
COSTS = _costs()
LENGTHS = _lengths()


@inner("int64(int32[:,::1], int64, int64)")
def beside(neighbours: Int32s, slot: int, k: int) -> int:
    """Return the slot in direction k of a slot."""
    move = MOVES[(slot & 511) * 27 + k]
    return int((int(neighbours[slot >> 9, move >> 9]) << 9) | (move & 511))


@inner("int64(int32[:,::1], int64)")
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
