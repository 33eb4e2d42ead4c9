"""Which voxels a segment's likelihood ellipsoid covers, and what it adds to them (paper eq. 1).

Voxel (x, y, z) covers [x, x + 1) voxel sizes in base; all lengths here are in voxels. Sums are
integers, so the order of segments and views does not matter, to the bit.
"""

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Int32s = NDArray[np.int32]

UNITS_PER_NAT = 65536
"""Fixed point of the map: -log(1 - p) in units of 1/65536 nat."""
MAX_SUM = 1 << 30
"""Sums saturate here (16384 nat): room for one more addition below the int32 limit."""


@njit(cache=True, nogil=True)
def row_range(
    start: Floats, axis: Floats, length: float, radius: float, reach: float, x: int, y: int
) -> tuple[int, int]:
    """Return [first, last) z of the row of voxel centres (x, y) inside the segment's support box.

    The box is the cylinder d_r <= reach * radius cut to d_l <= reach * length; it contains the
    ellipsoid. Empty rows give first >= last.
    """
    wx, wy = x + 0.5 - start[0], y + 0.5 - start[1]
    across = wx * axis[0] + wy * axis[1]
    # |w|^2 - (w . axis)^2 <= (reach * radius)^2 is a quadratic a z^2 + 2 b z + c <= 0 in z.
    a = 1.0 - axis[2] * axis[2]
    b = -across * axis[2]
    c = wx * wx + wy * wy - across * across - (reach * radius) ** 2
    low, high = -1e9, 1e9
    if a > 1e-12:
        root = b * b - a * c
        if root < 0.0:
            return 0, 0
        low, high = (-b - math.sqrt(root)) / a, (-b + math.sqrt(root)) / a
    elif c > 0.0:
        return 0, 0
    if abs(axis[2]) > 1e-12:
        near = (-reach * length - across) / axis[2]
        far = ((reach + 1.0) * length - across) / axis[2]
        low, high = max(low, min(near, far)), min(high, max(near, far))
    elif not -reach * length <= across <= (reach + 1.0) * length:
        return 0, 0
    return math.ceil(start[2] + low - 0.5), math.floor(start[2] + high - 0.5) + 1


@njit(cache=True, nogil=True)
def box_of(
    start: Floats, axis: Floats, length: float, radius: float, reach: float, dimension: int
) -> tuple[int, int]:
    """Return [first, last) voxel of the support box along x (0) or y (1)."""
    near = start[dimension] - axis[dimension] * reach * length
    far = start[dimension] + axis[dimension] * (reach + 1.0) * length
    margin = reach * radius * math.sqrt(max(0.0, 1.0 - axis[dimension] ** 2))
    return math.floor(min(near, far) - margin), math.floor(max(near, far) + margin) + 1


@njit(cache=True, nogil=True)
def rows_of_segments(
    starts: Floats, axes: Floats, lengths: Floats, radii: Floats, reach: float
) -> Int32s:
    """Return (R, 5) int32 rows (segment, x, y, first z, last z) that cover all supports."""
    count = 0
    rows = np.zeros((1024, 5), dtype=np.int32)
    for i in range(len(starts)):
        x0, x1 = box_of(starts[i], axes[i], lengths[i], radii[i], reach, 0)
        y0, y1 = box_of(starts[i], axes[i], lengths[i], radii[i], reach, 1)
        for x in range(x0, x1):
            for y in range(y0, y1):
                z0, z1 = row_range(starts[i], axes[i], lengths[i], radii[i], reach, x, y)
                if z0 >= z1:
                    continue
                if count == len(rows):
                    grown = np.zeros((2 * count, 5), dtype=np.int32)
                    grown[:count] = rows
                    rows = grown
                rows[count] = (i, x, y, z0, z1)
                count += 1
    return rows[:count].copy()


@njit(cache=True, nogil=True)
def units_at(
    start: Floats,
    axis: Floats,
    length: float,
    radius: float,
    confidence: float,
    k: float,
    x: int,
    y: int,
    z: int,
) -> int:
    """Return the fixed-point -log(1 - p_o) of a voxel centre (paper eq. 1; 0 outside)."""
    wx, wy, wz = x + 0.5 - start[0], y + 0.5 - start[1], z + 0.5 - start[2]
    along = wx * axis[0] + wy * axis[1] + wz * axis[2]
    # The perpendicular part itself, since |w|^2 - along^2 cancels for long thin segments.
    rx, ry, rz = wx - along * axis[0], wy - along * axis[1], wz - along * axis[2]
    axial = max(0.0, -along, along - length) / length
    radial = math.sqrt(rx * rx + ry * ry + rz * rz) / radius
    p = confidence - confidence / k * math.sqrt(axial * axial + radial * radial)
    if p <= 0.0:
        return 0
    return round(-math.log1p(-p) * UNITS_PER_NAT)


@njit(cache=True, nogil=True)
def voxels_on_segment(start: Floats, end: Floats) -> Int32s:
    """Return (N, 3) voxels a segment passes through (Amanatides and Woo's traversal)."""
    voxel = np.floor(start).astype(np.int32)
    last = np.floor(end).astype(np.int32)
    steps = int(np.abs(last - voxel).sum())
    visited = np.zeros((steps + 1, 3), dtype=np.int32)
    direction = end - start
    to_next = np.full(3, np.inf)
    per_voxel = np.full(3, np.inf)
    for i in range(3):
        if last[i] != voxel[i]:
            border = voxel[i] + 1 if direction[i] > 0 else voxel[i]
            to_next[i] = (border - start[i]) / direction[i]
            per_voxel[i] = 1.0 / abs(direction[i])
    visited[0] = voxel
    for step in range(1, steps + 1):
        i = int(np.argmin(to_next))
        voxel[i] += 1 if direction[i] > 0 else -1
        to_next[i] = np.inf if voxel[i] == last[i] else to_next[i] + per_voxel[i]
        visited[step] = voxel
    return visited


@njit(cache=True, nogil=True)
def mark_blocks(rows: Int32s, top: Int32s, origin: Ints) -> None:
    """Set top = -2 for every unallocated (-1) 8^3 block that a row touches."""
    for r in range(len(rows)):
        bx, by = (rows[r, 1] >> 3) - origin[0], (rows[r, 2] >> 3) - origin[1]
        for bz in range((rows[r, 3] >> 3) - origin[2], ((rows[r, 4] - 1) >> 3) - origin[2] + 1):
            if top[bx, by, bz] == -1:
                top[bx, by, bz] = -2


@njit(cache=True, nogil=True)
def add_to(sums: Int32s, top: Int32s, origin: Ints, x: int, y: int, z: int, units: int) -> None:
    """Add to one voxel's sum, saturating at MAX_SUM; its block must be allocated."""
    block = top[(x >> 3) - origin[0], (y >> 3) - origin[1], (z >> 3) - origin[2]]
    offset = ((x & 7) << 6) | ((y & 7) << 3) | (z & 7)
    sums[block, offset] = min(sums[block, offset] + units, MAX_SUM)


@njit(cache=True, nogil=True)
def accumulate(
    rows: Int32s,
    starts: Floats,
    axes: Floats,
    lengths: Floats,
    radii: Floats,
    confidences: Floats,
    k: float,
    sums: Int32s,
    top: Int32s,
    origin: Ints,
) -> None:
    """Add every segment's ellipsoid to the sums, voxels on the segment with p_o = c (rule 1)."""
    for r in range(len(rows)):
        i, x, y = rows[r, 0], rows[r, 1], rows[r, 2]
        for z in range(rows[r, 3], rows[r, 4]):
            units = units_at(starts[i], axes[i], lengths[i], radii[i], confidences[i], k, x, y, z)
            if units > 0:
                add_to(sums, top, origin, x, y, z, units)
    for i in range(len(starts)):
        full = round(-math.log1p(-confidences[i]) * UNITS_PER_NAT)
        for x, y, z in voxels_on_segment(starts[i], starts[i] + lengths[i] * axes[i]):
            units = units_at(starts[i], axes[i], lengths[i], radii[i], confidences[i], k, x, y, z)
            add_to(sums, top, origin, x, y, z, full - units)
