"""Space as voxels, of which only the blocks that are used take memory."""

from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from canopy_skel.geometry import FloatArray, IntArray
from canopy_skel.kernels import blocks, grid

Int32Array = NDArray[np.int32]
Scalar = TypeVar("Scalar", bound=np.generic)


def voxels_of(points_in_base: FloatArray, voxel_size_m: float) -> Int32Array:
    """Return the voxels (N, 3) that (N, 3) points lie in."""
    return np.floor(points_in_base / voxel_size_m).astype(np.int32)


def grouped(voxels: Int32Array) -> tuple[IntArray, IntArray]:
    """Return the order (N,) that sorts (N, 3) voxels by x, y, z, and where in it each is first met.

    Equal voxels keep their order. Sorting numbers that hold both voxel and place is several times
    faster than `np.lexsort`.
    """
    if len(voxels) == 0:
        return np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64)
    bits, low = len(voxels).bit_length(), voxels.min(axis=0).astype(np.int64)
    span = voxels.max(axis=0) - low + 1
    if float(np.prod(span.astype(np.float64))) * 2.0**bits >= 2.0**63:
        order = np.asarray(np.lexsort(voxels.T[::-1]))
        steps = np.abs(np.diff(voxels[order], axis=0)).sum(axis=1)
        return order, np.append(0, 1 + np.flatnonzero(steps))
    x, y, z = (voxels - low).T
    keys = ((x * span[1] + y) * span[2] + z) << bits | np.arange(len(voxels))
    keys.sort()
    return keys & ((1 << bits) - 1), np.append(0, 1 + np.flatnonzero(np.diff(keys >> bits)))


def distinct(voxels: Int32Array) -> Int32Array:
    """Return each of (N, 3) voxels once, in order."""
    order, starts = grouped(voxels)
    return voxels[order[starts]]


def grown(array: NDArray[Scalar], length: int, fill: int) -> NDArray[Scalar]:
    """Return the array with room for `length` entries, in doubling steps; new ones are `fill`."""
    if length <= len(array):
        return array
    shape = (max(length, 2 * len(array)), *array.shape[1:])
    # Zeros take no memory until they are written.
    larger = np.zeros(shape, dtype=array.dtype)
    larger[: len(array)] = array
    if fill:
        larger[len(array) :] = fill
    return larger


class VoxelBlocks:
    """Numbers voxels by slots: block * 512 + place in its 8^3 block.

    Arrays over slots hold what is known of the voxels. Block 0 stands for all that is not
    allocated: nothing may be written there.
    """

    def __init__(self) -> None:
        self.count = 1
        self.origin: IntArray = np.zeros(3, dtype=np.int64)
        self.top: Int32Array = np.zeros((0, 0, 0), dtype=np.int32)
        self.places: Int32Array = np.zeros((64, 3), dtype=np.int32)
        self.neighbours: Int32Array = np.zeros((64, 27), dtype=np.int32)

    @property
    def slots(self) -> int:
        """How many slots there are, those of block 0 included."""
        return self.count * grid.SLOTS

    def cover(self, voxels: Int32Array) -> None:
        """Allocate the blocks that hold voxels (N, 3)."""
        if len(voxels) == 0:
            return
        block = voxels.astype(np.int64) >> 3
        self.span(block.min(axis=0), block.max(axis=0) + 1)
        used = np.unique(np.ravel_multi_index(tuple((block - self.origin).T), self.top.shape))
        fresh = used[self.top.ravel()[used] == 0]
        self.top.ravel()[fresh] = self.count + np.arange(len(fresh))
        self.number(self.count + len(fresh))

    def number(self, count: int) -> None:
        """Take over the blocks below `count` that were entered into `top`."""
        before, self.count = self.count, count
        if count > before:
            fresh = np.argwhere(self.top >= before)
            self.places = grown(self.places, self.count, 0)
            self.neighbours = grown(self.neighbours, self.count, 0)
            self.places[self.top[tuple(fresh.T)]] = fresh + self.origin
            blocks.connect(self.top, self.neighbours, np.ascontiguousarray(fresh))

    def slots_of(self, voxels: Int32Array) -> IntArray:
        """Return the slots (N,) of (N, 3) voxels; below 512 where nothing is allocated."""
        slots: IntArray = blocks.slots_of(self.top, self.origin, np.ascontiguousarray(voxels))
        return slots

    def voxels_at(self, slots: IntArray) -> Int32Array:
        """Return the voxels (N, 3) of (N,) slots."""
        inside = np.stack([slots >> 6 & 7, slots >> 3 & 7, slots & 7], axis=1)
        return np.asarray(self.places[slots >> 9] * 8 + inside, dtype=np.int32)

    def span(self, low: IntArray, high: IntArray) -> None:
        """Grow the top table so that it spans blocks [low, high)."""
        if self.top.size:
            low = np.minimum(low, self.origin)
            high = np.maximum(high, self.origin + self.top.shape)
        if (low == self.origin).all() and (high - low == self.top.shape).all():
            return
        top = np.zeros(high - low, dtype=np.int32)
        if self.top.size:
            x, y, z = self.origin - low
            nx, ny, nz = self.top.shape
            top[x : x + nx, y : y + ny, z : z + nz] = self.top
        self.origin, self.top = low, top


class VoxelIndex:
    """Finds voxels by their coordinates in a list (N, 3) int32 of distinct ones."""

    def __init__(self, voxels: Int32Array) -> None:
        block = voxels >> 3
        low = block.min(axis=0) if len(voxels) else np.zeros(3)
        high = block.max(axis=0) if len(voxels) else np.zeros(3)
        self.origin: IntArray = low.astype(np.int64)
        self.top: Int32Array = np.full((high - low + 1).astype(np.int64), -1, dtype=np.int32)
        self.slots: Int32Array = blocks.index_voxels(
            np.ascontiguousarray(voxels), self.top, self.origin
        )

    def find(self, voxels: Int32Array) -> Int32Array:
        """Return the places (M,) of (M, 3) voxels in the list; -1 for those not in it."""
        return blocks.find_all(self.top, self.origin, self.slots, np.ascontiguousarray(voxels))
