"""The 3-D likelihood map: skeleton occupancy of seen and unseen voxels (paper III-C)."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from canopy_skel.errors import UsageError
from canopy_skel.geometry import FloatArray, IntArray
from canopy_skel.kernels import blocks, ellipsoid
from canopy_skel.spline import BranchSpline

Int32Array = NDArray[np.int32]
BYTES_PER_VOXEL = 128
"""Sums, rows and what the path search needs per voxel of the map: what the limit counts."""
THICKEST_VOXEL_M = 0.1
"""A larger voxel holds several branches: the map could not tell them apart."""


@dataclass(frozen=True, kw_only=True, slots=True)
class LikelihoodConfig:
    """The paper's k = 3; max_confidence keeps -log(1 - c) finite (c = 1 would end all costs)."""

    voxel_size_m: float = 0.005
    k: float = 3.0
    max_confidence: float = 0.999

    def __post_init__(self) -> None:
        """Check the range once."""
        if not 0 < self.voxel_size_m <= THICKEST_VOXEL_M:
            raise UsageError(
                f"voxel size {self.voxel_size_m} m: give a length above 0 and up to"
                f" {THICKEST_VOXEL_M}, such as 0.005"
            )


@dataclass(frozen=True, kw_only=True, eq=False, slots=True)
class Segments:
    """Straight pieces of wood, the atoms of the map.

    starts_in_base, ends_in_base: (S, 3) metres. radius_m, confidence: (S,).
    """

    starts_in_base: FloatArray
    ends_in_base: FloatArray
    radius_m: FloatArray
    confidence: FloatArray


def segments_of(splines: Sequence[BranchSpline]) -> Segments:
    """Cut splines into their straight pieces, in order."""
    pieces = [len(spline.control_points_in_base) - 1 for spline in splines]
    points = [spline.control_points_in_base for spline in splines]
    empty: list[FloatArray] = [np.zeros((0, 3))]
    return Segments(
        starts_in_base=np.concatenate(empty + [p[:-1] for p in points]),
        ends_in_base=np.concatenate(empty + [p[1:] for p in points]),
        radius_m=np.repeat([spline.radius_m for spline in splines], pieces),
        confidence=np.repeat([spline.confidence for spline in splines], pieces),
    )


@dataclass(frozen=True, kw_only=True, eq=False, slots=True)
class LikelihoodGrid:
    """A snapshot of the map: the voxels with p_l > 0.

    voxels: (N, 3) int32, in lexicographic order; voxel v covers [v, v + 1) * voxel_size_m in base.
    units: (N,) int32, -log(1 - p_l) in 1/65536 nat.
    """

    voxel_size_m: float
    voxels: Int32Array
    units: Int32Array

    def empty_probability(self) -> FloatArray:
        """Return q = 1 - p_l (N,), exact where p_l itself would round to 1."""
        return np.asarray(np.exp(self.units / -ellipsoid.UNITS_PER_NAT), dtype=np.float64)

    def probability(self) -> FloatArray:
        """Return p_l (N,)."""
        return np.asarray(-np.expm1(self.units / -ellipsoid.UNITS_PER_NAT), dtype=np.float64)

    def centres_in_base(self) -> FloatArray:
        """Return the voxel centres (N, 3) in metres."""
        return np.asarray((self.voxels + 0.5) * self.voxel_size_m, dtype=np.float64)


class VoxelIndex:
    """Finds voxels by their coordinates in a list (N, 3) int32 of distinct ones."""

    def __init__(self, voxels: Int32Array) -> None:
        block = voxels >> 3
        low = block.min(axis=0) if len(voxels) else np.zeros(3)
        high = block.max(axis=0) if len(voxels) else np.zeros(3)
        self.origin: IntArray = low.astype(np.int64)
        self.top: Int32Array = np.full((high - low + 1).astype(np.int64), -1, dtype=np.int32)
        self.slots: Int32Array = blocks.index_voxels(voxels, self.top, self.origin)

    def find(self, voxels: Int32Array) -> Int32Array:
        """Return the places (M,) of (M, 3) voxels in the list; -1 for those not in it."""
        return blocks.find_all(self.top, self.origin, self.slots, voxels)


def voxels_of(points_in_base: FloatArray, voxel_size_m: float) -> Int32Array:
    """Return the voxels (N, 3) that (N, 3) points lie in."""
    return np.floor(points_in_base / voxel_size_m).astype(np.int32)


class LikelihoodMap:
    """The one mutable object of the method: integer sums of -log(1 - p_o) in 8^3 blocks.

    p_l <- 1 - (1 - p_l)(1 - p_o) (paper eq. 2) is a sum of -log(1 - p_o). Integers make it exact:
    any order of views gives the same bytes. Memory grows with the wood seen; of the box around it
    only a table of 4 bytes per block is kept.
    """

    def __init__(self, config: LikelihoodConfig, memory_limit_bytes: int = 3 << 30) -> None:
        self._config = config
        self._memory_limit_bytes = memory_limit_bytes
        self._origin: IntArray = np.zeros(3, dtype=np.int64)
        self._top: Int32Array = np.full((0, 0, 0), -1, dtype=np.int32)
        self._sums: Int32Array = np.zeros((0, 512), dtype=np.int32)

    def add(self, segments: Segments) -> None:
        """Update the map by what one view observed.

        Raises:
            UsageError: the map would not fit into the memory limit at this voxel size.
        """
        voxel = self._config.voxel_size_m
        direction = segments.ends_in_base - segments.starts_in_base
        length = np.linalg.norm(direction, axis=1)
        kept = length > 1e-9
        if not kept.any():
            return
        lengths, radii = length[kept] / voxel, np.maximum(segments.radius_m[kept] / voxel, 1e-6)
        starts = segments.starts_in_base[kept] / voxel
        self._check_memory(starts, lengths, radii)
        axes = direction[kept] / length[kept, None]
        k = self._config.k
        rows = ellipsoid.rows_of_segments(starts, axes, lengths, radii, k)
        on_segments = [
            ellipsoid.voxels_on_segment(s, s + n * a)
            for s, n, a in zip(starts, lengths, axes, strict=True)
        ]
        self._allocate(rows, np.concatenate(on_segments))
        confidences = np.minimum(segments.confidence[kept], self._config.max_confidence)
        ellipsoid.accumulate(
            rows, starts, axes, lengths, radii, confidences, k, self._sums, self._top, self._origin
        )

    def grid(self) -> LikelihoodGrid:
        """Return the voxels with p_l > 0 in canonical order."""
        place = np.argwhere(self._top >= 0)
        block, offset = np.nonzero(self._sums[self._top[tuple(place.T)]])
        inside = np.stack([offset >> 6, (offset >> 3) & 7, offset & 7], axis=1)
        voxels = ((place[block] + self._origin) * 8 + inside).astype(np.int32)
        units = self._sums[self._top[tuple(place[block].T)], offset]
        order = np.lexsort(voxels.T[::-1])
        return LikelihoodGrid(
            voxel_size_m=self._config.voxel_size_m, voxels=voxels[order], units=units[order]
        )

    @property
    def voxel_size_m(self) -> float:
        """The edge of a voxel."""
        return self._config.voxel_size_m

    def occupied(self) -> int:
        """Return the number of voxels with p_l > 0."""
        return int(np.count_nonzero(self._sums))

    def probability_at(self, voxels: Int32Array) -> FloatArray:
        """Return p_l (N,) of (N, 3) voxels."""
        block, inside = (voxels >> 3) - self._origin, voxels & 7
        units = np.zeros(len(voxels))
        known = np.flatnonzero(np.all((block >= 0) & (block < self._top.shape), axis=1))
        slot = self._top[tuple(block[known].T)]
        known, slot = known[slot >= 0], slot[slot >= 0]
        x, y, z = inside[known].T
        units[known] = self._sums[slot, (x << 6) | (y << 3) | z]
        return np.asarray(-np.expm1(units / -ellipsoid.UNITS_PER_NAT), dtype=np.float64)

    def _check_memory(self, starts: FloatArray, lengths: FloatArray, radii: FloatArray) -> None:
        k = self._config.k
        support = np.pi * (k * radii + 1) ** 2 * ((2 * k + 1) * lengths + 2)
        reach = (k + 1) * lengths.max() + k * radii.max()
        low, high = starts.min(axis=0) - reach, starts.max(axis=0) + reach
        if self._top.size:
            low = np.minimum(low, 8.0 * self._origin)
            high = np.maximum(high, 8.0 * (self._origin + self._top.shape))
        table = 4.0 * float(np.prod((high - low) / 8.0 + 2.0))
        needed = (self._sums.size + float(support.sum())) * BYTES_PER_VOXEL + table
        if needed > self._memory_limit_bytes:
            # Further views will add to the map: advise with room for four times as much.
            fits = self._config.voxel_size_m * (4 * needed / self._memory_limit_bytes) ** (1 / 3)
            raise UsageError(
                f"voxel size {self._config.voxel_size_m} m: the likelihood map would need about"
                f" {needed / 2**30:.1f} GiB of {self._memory_limit_bytes / 2**30:.1f} GiB;"
                f" {np.ceil(fits * 1e4) / 1e4:g} m fits"
            )

    def _allocate(self, rows: Int32Array, voxels: Int32Array) -> None:
        thin = np.concatenate([np.zeros((len(voxels), 1), np.int32), voxels, voxels[:, 2:] + 1], 1)
        rows = np.concatenate([rows, thin.astype(np.int32)])
        low = rows[:, [1, 2, 3]].min(axis=0) >> 3
        high = (rows[:, [1, 2, 4]] - [0, 0, 1]).max(axis=0) >> 3
        self._cover(low.astype(np.int64), high.astype(np.int64) + 1)
        ellipsoid.mark_blocks(rows, self._top, self._origin)
        fresh = np.argwhere(self._top == -2)
        self._top[tuple(fresh.T)] = len(self._sums) + np.arange(len(fresh))
        self._sums = np.concatenate([self._sums, np.zeros((len(fresh), 512), np.int32)])

    def _cover(self, low: IntArray, high: IntArray) -> None:
        """Grow the top table so that it spans blocks [low, high)."""
        if self._top.size:
            low = np.minimum(low, self._origin)
            high = np.maximum(high, self._origin + self._top.shape)
        if (low == self._origin).all() and (high - low == self._top.shape).all():
            return
        top = np.full(high - low, -1, dtype=np.int32)
        if self._top.size:
            x, y, z = self._origin - low
            nx, ny, nz = self._top.shape
            top[x : x + nx, y : y + ny, z : z + nz] = self._top
        self._origin, self._top = low, top
