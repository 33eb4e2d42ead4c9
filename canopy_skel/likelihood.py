"""The 3-D likelihood map: skeleton occupancy of seen and unseen voxels (paper III-C)."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

from canopy_skel.errors import UsageError
from canopy_skel.geometry import FloatArray, IntArray
from canopy_skel.kernels import ellipsoid, grid, sums
from canopy_skel.spline import BranchSpline
from canopy_skel.voxels import Int32Array, VoxelBlocks, grown

Runs = tuple[IntArray, Int32Array, NDArray[np.float32], NDArray[np.int8]]
"""Where those of each segment start; the runs; their terms (3, R); places of single voxels."""

BYTES_PER_SLOT = 40
"""Sums, levels and the path search, with room to grow: what the limit counts per slot."""
MOST_SLOTS_PER_VOXEL = 3.0
"""Blocks around thin wood are about a third full."""
THICKEST_VOXEL_M = 0.1
"""A larger voxel holds several branches: the map could not tell them apart."""


LEVELS = 255
"""p_l is rounded to 1 / LEVELS where paths are searched."""


@cache
def level_table() -> NDArray[np.uint8]:
    """Return the level, 255 p_l rounded but at least 1, of sums >> LEVEL_SHIFT."""
    nat = (np.arange(6400) + 0.5) * (1 << sums.LEVEL_SHIFT) / sums.UNITS_PER_NAT
    return np.maximum(np.round(-LEVELS * np.expm1(-nat)), 1).astype(np.uint8)


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
        if not 0.1 <= self.k <= 100:
            raise UsageError(f"k {self.k}: give 0.1 to 100, such as the paper's 3")
        if not 0 < self.max_confidence < 1:
            raise UsageError(
                f"max_confidence {self.max_confidence}: give one above 0 and below 1, such as 0.999"
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
        return np.asarray(np.exp(self.units / -sums.UNITS_PER_NAT), dtype=np.float64)

    def probability(self) -> FloatArray:
        """Return p_l (N,)."""
        return np.asarray(-np.expm1(self.units / -sums.UNITS_PER_NAT), dtype=np.float64)

    def centres_in_base(self) -> FloatArray:
        """Return the voxel centres (N, 3) in metres."""
        return np.asarray((self.voxels + 0.5) * self.voxel_size_m, dtype=np.float64)


class LikelihoodMap:
    """The map that grows: integer sums of -log(1 - p_o) in 8^3 blocks.

    p_l <- 1 - (1 - p_l)(1 - p_o) (paper eq. 2) is a sum of -log(1 - p_o). Integers make it exact:
    any order of views gives the same bytes, and a view can be taken off again. Memory grows with
    the wood seen; of the box around it only a table of 4 bytes per block is kept.

    blocks: numbers the voxels. levels: per slot, 255 p_l rounded, at least 1 where p_l > 0.
    """

    def __init__(self, config: LikelihoodConfig, memory_limit_bytes: int = 3 << 30) -> None:
        self._config = config
        self._memory_limit_bytes = memory_limit_bytes
        self.blocks = VoxelBlocks()
        self.levels: NDArray[np.uint8] = np.zeros(self.blocks.slots, dtype=np.uint8)
        self._sums: Int32Array = np.zeros(self.blocks.slots, dtype=np.int32)
        self._marks: NDArray[np.uint8] = np.zeros(self.blocks.slots, dtype=np.uint8)
        self._changed: list[Int32Array] = []

    @property
    def voxel_size_m(self) -> float:
        """Edge length of a voxel."""
        return self._config.voxel_size_m

    @property
    def nbytes(self) -> int:
        """Memory held, in bytes."""
        kept = (self.levels, self._sums, self._marks, self.blocks.top)
        return sum(array.nbytes for array in kept)

    @property
    def saturated(self) -> bool:
        """Whether some sum has hit its limit: then nothing can be taken off exactly."""
        return bool((self._sums == sums.MAX_SUM).any())

    def add(self, segments: Segments) -> None:
        """Update the map by what one view observed.

        Raises:
            UsageError: the map would not fit into the memory limit at this voxel size.
        """
        self._accumulate(segments, 1)

    def remove(self, segments: Segments) -> None:
        """Take off what was added; the map must not be `saturated`."""
        self._accumulate(segments, -1)

    def merge(self, grid: LikelihoodGrid) -> None:
        """Add what another map of the same voxel size knows."""
        self.blocks.cover(grid.voxels)
        self._grow()
        slots = self.blocks.slots_of(grid.voxels)
        total = self._sums[slots].astype(np.int64) + grid.units
        self._sums[slots] = np.minimum(total, sums.MAX_SUM)
        table = level_table()
        places = np.minimum(self._sums[slots] >> sums.LEVEL_SHIFT, len(table) - 1)
        self.levels[slots] = table[places]
        self._changed.append(slots[self._marks[slots] == 0].astype(np.int32))
        self._marks[slots] = 1

    def take_changed(self) -> Int32Array:
        """Return the slots whose level may have changed since this was last called."""
        changed = np.concatenate([np.zeros(0, dtype=np.int32), *self._changed])
        self._changed = []
        self._marks[changed] = 0
        return changed

    def occupied(self) -> int:
        """Return the number of voxels with p_l > 0."""
        return int(np.count_nonzero(self.levels))

    def probability_at(self, voxels: Int32Array) -> FloatArray:
        """Return p_l (N,) of (N, 3) voxels."""
        units = self._sums[self.blocks.slots_of(voxels)]
        return np.asarray(-np.expm1(units / -sums.UNITS_PER_NAT), dtype=np.float64)

    def empty_probability_at(self, voxels: Int32Array) -> FloatArray:
        """Return 1 - p_l (N,) of (N, 3) voxels, exact where p_l itself would round to 1."""
        units = self._sums[self.blocks.slots_of(voxels)]
        return np.asarray(np.exp(units / -sums.UNITS_PER_NAT), dtype=np.float64)

    def grid(self) -> LikelihoodGrid:
        """Return the voxels with p_l > 0 in canonical order."""
        slots = np.flatnonzero(self._sums)
        voxels = self.blocks.voxels_at(slots)
        order = np.lexsort(voxels.T[::-1])
        return LikelihoodGrid(
            voxel_size_m=self.voxel_size_m, voxels=voxels[order], units=self._sums[slots[order]]
        )

    def _accumulate(self, segments: Segments, sign: int) -> None:
        rows = self._rows(segments)
        if len(rows) == 0:
            return
        k = self._config.k
        if sign > 0:
            self._check_memory(rows)
        self.blocks.span(*ellipsoid.bounds_of_segments(rows, k))
        wide, thin = self._runs(rows)
        self._grow()
        slopes, found = _slopes(rows, k), 0
        seen = np.empty(len(wide[1]) + len(thin[1]), dtype=np.int32)
        totals = self._sums.reshape(-1, grid.RUN)
        levels, marks = (a.reshape(-1, grid.RUN) for a in (self.levels, self._marks))
        for runs in (wide, thin):
            found = sums.accumulate(*runs, slopes, sign, totals, marks, seen, found)
        self._changed.append(sums.renew_levels(seen[:found], totals, levels, level_table(), marks))

    def _runs(self, rows: FloatArray) -> tuple[Runs, Runs]:
        """Return the runs of the supports, and of the voxels that the segments pass through."""
        k, blocks = self._config.k, self.blocks
        room = ellipsoid.room_for(rows, k)
        wide = _empty_runs(len(rows), room, 0)
        count = ellipsoid.runs_of_segments(
            rows, k, blocks.top, blocks.origin, blocks.count, *wide[:3]
        )
        passed = ellipsoid.rows_on_segments(rows)
        thin = _empty_runs(len(rows), len(passed), len(passed))
        count = ellipsoid.runs_on_segments(rows, passed, blocks.top, blocks.origin, count, *thin)
        blocks.number(count)
        return wide, thin

    def _rows(self, segments: Segments) -> FloatArray:
        """Return the segments that have a length as the kernels take them, (S, 9) in voxels."""
        voxel = self._config.voxel_size_m
        direction = segments.ends_in_base - segments.starts_in_base
        length_m = np.linalg.norm(direction, axis=1)
        kept = length_m > 1e-9
        return np.column_stack(
            [
                segments.starts_in_base[kept] / voxel,
                direction[kept] / length_m[kept, None],
                length_m[kept] / voxel,
                np.maximum(segments.radius_m[kept] / voxel, 1e-6),
                np.minimum(segments.confidence[kept], self._config.max_confidence),
            ]
        )

    def _grow(self) -> None:
        self.levels = grown(self.levels, self.blocks.slots, 0)
        self._sums = grown(self._sums, self.blocks.slots, 0)
        self._marks = grown(self._marks, self.blocks.slots, 0)

    def _check_memory(self, rows: FloatArray) -> None:
        k, starts, lengths, radii = self._config.k, rows[:, :3], rows[:, 6], rows[:, 7]
        around = k * radii + 1
        support = np.pi * around**2 * ((2 * k + 1) * lengths + 2)
        # Blocks of 8 stick out of what they cover, of thick wood by less.
        support *= np.minimum((1.0 + 8.0 / around) ** 2, MOST_SLOTS_PER_VOXEL)
        reach = (k + 1) * lengths.max() + k * radii.max()
        low, high = starts.min(axis=0) - reach, starts.max(axis=0) + reach
        if self.blocks.top.size:
            low = np.minimum(low, 8.0 * self.blocks.origin)
            high = np.maximum(high, 8.0 * (self.blocks.origin + self.blocks.top.shape))
        table = 4.0 * float(np.prod((high - low) / 8.0 + 2.0))
        needed = (self.blocks.slots + float(support.sum())) * BYTES_PER_SLOT + table
        if needed > self._memory_limit_bytes:
            # Further views will add to the map: advise with room for four times as much.
            fits = self._config.voxel_size_m * (4 * needed / self._memory_limit_bytes) ** (1 / 3)
            raise UsageError(
                f"voxel size {self._config.voxel_size_m} m: the likelihood map would need about"
                f" {needed / 2**30:.1f} GiB of {self._memory_limit_bytes / 2**30:.1f} GiB;"
                f" {np.ceil(fits * 1e4) / 1e4:g} m fits"
            )


def _empty_runs(segments: int, room: int, places: int) -> Runs:
    return (
        np.zeros(segments + 1, dtype=np.int64),
        np.empty(room, dtype=np.int32),
        np.empty((3, room), dtype=np.float32),
        np.empty(places, dtype=np.int8),
    )


def _slopes(rows: FloatArray, k: float) -> NDArray[np.float32]:
    """Return (S, 4): what a step in z adds to slide and place; 1 - c; how 1 - p_o then grows."""
    across = np.hypot(rows[:, 3], rows[:, 4]) / rows[:, 7]
    along, confidence = rows[:, 5] / rows[:, 6], rows[:, 8]
    return np.column_stack([across, along, 1.0 - confidence, confidence / k]).astype(np.float32)
