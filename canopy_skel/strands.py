"""Samples of all segments, merged where they agree, and moved onto the curves they lie on.

Samples in one half-voxel that run roughly the same way are one strand: integer sums of their
positions, directions and radii. So the number of strands is bounded by the tree, not by the views;
the order of views does not matter to the bit; and a view can be taken off again.
"""

from dataclasses import dataclass

import numpy as np

from canopy_skel.geometry import BoolArray, FloatArray, IntArray
from canopy_skel.kernels import smooth
from canopy_skel.likelihood import Segments
from canopy_skel.voxels import Int32Array, VoxelIndex, distinct, grouped, voxels_of

UNITS_PER_M = 1 << 22
"""Fixed point of positions and radii."""
UNITS_PER_DIRECTION = 1 << 20
CELLS_PER_VOXEL = 2
"""Along an edge. Coarser, and the strands of one curve may leave out a voxel."""
_BIAS = 1 << 19
_AROUND = (np.argwhere(np.ones((3, 3, 3))) - 1).astype(np.int32)


@dataclass(frozen=True, kw_only=True, slots=True)
class SmoothingConfig:
    """How strands are moved onto a curve.

    Each of `steps` moves them to the mean of their neighbours, across the local direction only,
    with Gaussian weights of `bandwidth_m` cut at twice that, neighbours within `max_angle_deg` of
    their direction.
    """

    steps: int = 3
    bandwidth_m: float = 0.012
    max_angle_deg: float = 45.0


@dataclass(frozen=True, kw_only=True, eq=False, slots=True)
class Strands:
    """Points on wood: points_in_base (N, 3); radius_m and weight (N,). In canonical order."""

    points_in_base: FloatArray
    radius_m: FloatArray
    weight: FloatArray


class StrandMap:
    """Keeps the strands of all segments so far, smoothed where something has changed."""

    def __init__(self, voxel_size_m: float, config: SmoothingConfig) -> None:
        self._voxel_size_m, self._config = voxel_size_m, config
        self._reach_m = 2.0 * config.bandwidth_m
        self._origin: Int32Array | None = None
        # By strand, in the order of their keys: sums of 1, position, direction, radius.
        self._keys: IntArray = np.zeros(0, dtype=np.int64)
        self._sums: IntArray = np.zeros((0, 8), dtype=np.int64)
        self._fresh: BoolArray = np.zeros(0, dtype=bool)
        self._moved: FloatArray = np.zeros((0, 3))
        self._track: Int32Array = np.zeros((0, config.steps, 3), dtype=np.int32)
        self._changed: list[Int32Array] = []

    def add(self, segments: Segments) -> None:
        """Take in the segments of a view."""
        self._accumulate(segments, 1)

    def remove(self, segments: Segments) -> None:
        """Take off segments that were added."""
        self._accumulate(segments, -1)

    def smoothed(self) -> Strands:
        """Return all strands where the smoothing leaves them.

        The paper's mean (eq. 3) pulls points along the curve as well and collapses them into
        clumps; only the part across the local direction is applied, and the references stay where
        they were observed. That makes the result a function of strands within reach, so only those
        around a change are computed anew.
        """
        points, directions = self._means()
        stale = np.flatnonzero(self._stale())
        if len(stale):
            self._smooth(points, directions, stale)
        self._fresh[:] = False
        self._changed = []
        return Strands(
            points_in_base=self._moved,
            radius_m=self._sums[:, 7] / (self._sums[:, 0] * UNITS_PER_M),
            weight=self._sums[:, 0].astype(np.float64),
        )

    def _means(self) -> tuple[FloatArray, FloatArray]:
        points = self._sums[:, 1:4] / (self._sums[:, :1] * UNITS_PER_M)
        directions = self._sums[:, 4:7].astype(np.float64)
        return points, directions / np.linalg.norm(directions, axis=1)[:, None]

    def _accumulate(self, segments: Segments, sign: int) -> None:
        keys, sums = self._strands_of(segments)
        if len(keys) == 0:
            return
        at = np.searchsorted(self._keys, keys)
        known = at < len(self._keys)
        known[known] = self._keys[at[known]] == keys[known]
        self._note_cells(self._sums[at[known]])
        if not known.all():
            new = ~known
            self._keys = np.insert(self._keys, at[new], keys[new])
            self._sums = np.insert(self._sums, at[new], 0, axis=0)
            self._fresh = np.insert(self._fresh, at[new], True)
            self._moved = np.insert(self._moved, at[new], 0.0, axis=0)
            self._track = np.insert(self._track, at[new], 0, axis=0)
            at = np.searchsorted(self._keys, keys)
        self._sums[at] += sign * sums
        self._fresh[at] = True
        left = self._sums[:, 0] > 0
        self._note_cells(self._sums[at[left[at]]])
        if not left.all():
            self._keys, self._sums = self._keys[left], self._sums[left]
            self._fresh, self._moved = self._fresh[left], self._moved[left]
            self._track = self._track[left]

    def _strands_of(self, segments: Segments) -> tuple[IntArray, IntArray]:
        """Return the keys (N,) and sums (N, 8) of what segments add."""
        points, directions, radius_m = sample_segments(segments, 0.5 * self._voxel_size_m)
        if len(points) == 0:
            return np.zeros(0, dtype=np.int64), np.zeros((0, 8), dtype=np.int64)
        main = np.argmax(np.abs(directions), axis=1)
        sign = np.sign(directions[np.arange(len(main)), main])
        voxels = voxels_of(points, self._voxel_size_m / CELLS_PER_VOXEL)
        if self._origin is None:
            self._origin = voxels[0]
        x, y, z = (voxels.astype(np.int64) - self._origin + _BIAS).T
        key = x << 42 | y << 22 | z << 2 | main
        values = np.column_stack(
            [
                np.ones(len(points)),
                np.rint(points * UNITS_PER_M),
                np.rint(directions * sign[:, None] * UNITS_PER_DIRECTION),
                np.rint(radius_m * UNITS_PER_M),
            ]
        ).astype(np.int64)
        order = np.argsort(key, kind="stable")
        keys, first = np.unique(key[order], return_index=True)
        return keys, np.add.reduceat(values[order], first, axis=0)

    def _note_cells(self, sums: IntArray) -> None:
        """Remember which cells of the smoothing hold strands that change."""
        points = sums[:, 1:4] / (sums[:, :1] * UNITS_PER_M)
        self._changed.append(voxels_of(points, self._reach_m))

    def _stale(self) -> BoolArray:
        """Return which strands have a change within the cells that their smoothing looked at."""
        changed = np.concatenate([np.zeros((0, 3), dtype=np.int32), *self._changed])
        near = distinct((distinct(changed)[:, None] + _AROUND).reshape(-1, 3))
        if len(near) == 0:
            return self._fresh
        index = VoxelIndex(near)
        met = index.find(self._track.reshape(-1, 3)).reshape(self._track.shape[:2]) >= 0
        return np.asarray(self._fresh | met.any(axis=1))

    def _smooth(self, points: FloatArray, directions: FloatArray, chosen: IntArray) -> None:
        cell_of = voxels_of(points, self._reach_m)
        order, first = grouped(cell_of)  # by key within a cell
        index = VoxelIndex(cell_of[order[first]])
        references = np.column_stack([points, directions, self._sums[:, 0]])[order]
        moving, along = points[chosen], directions[chosen]
        for step in range(self._config.steps):
            self._track[chosen, step] = voxels_of(moving, self._reach_m)
            moving, along = smooth.mean_shift_across(
                moving,
                along,
                references,
                np.append(first, len(order)),
                index.top,
                index.origin,
                index.slots,
                self._reach_m,
                self._config.bandwidth_m,
                np.cos(np.radians(self._config.max_angle_deg)),
            )
        self._moved[chosen] = moving


def sample_segments(
    segments: Segments, spacing_m: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Put points on the segments, both ends included, no further apart than `spacing_m`.

    With at most half a voxel between them, the voxels they fall into are neighbours of each other.

    Returns:
        points in base (N, 3), unit directions (N, 3), radii (N,).
    """
    direction = segments.ends_in_base - segments.starts_in_base
    length = np.linalg.norm(direction, axis=1)
    used = np.flatnonzero(length > 1e-9)
    pieces = np.ceil(length[used] / spacing_m).astype(np.int64)
    of = np.repeat(used, pieces + 1)
    first = np.repeat(np.cumsum(pieces + 1) - pieces - 1, pieces + 1)
    along = (np.arange(len(of)) - first) / np.repeat(pieces, pieces + 1)
    points = segments.starts_in_base[of] + along[:, None] * direction[of]
    return points, direction[of] / length[of, None], segments.radius_m[of]
