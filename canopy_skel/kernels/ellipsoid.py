"""Which voxels a segment's likelihood ellipsoid covers, and what it adds to them (paper eq. 1).

Voxel (x, y, z) covers [x, x + 1) voxel sizes in base; all lengths here are in voxels. A segment is
a row (9,): start, unit axis, length, radius, confidence. Sums are integers, so the order of
segments and views does not matter, to the bit, and what was added can be taken off again. The
logarithm is made of +, *, / alone: the same bits on every machine.
"""

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from canopy_skel.kernels.blocks import slot_of

Bytes = NDArray[np.uint8]
Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Int32s = NDArray[np.int32]

UNITS_PER_NAT = 65536
"""Fixed point of the map: -log(1 - p) in units of 1/65536 nat."""
MAX_SUM = 1 << 30
"""Sums saturate here (16384 nat): room for one more addition below the int32 limit."""
LEVEL_SHIFT = 6
"""Levels are read off a table at sum >> 6: steps of 1/1024 nat."""
BATCH = 4096
LONGEST_ROW = 512


@njit("UniTuple(int64, 2)(float64[:,::1], int64, float64, int64)", cache=True, nogil=True)
def box_of(segments: Floats, i: int, reach: float, dimension: int) -> tuple[int, int]:
    """Return [first, end) voxel of segment i's support along x (0) or y (1)."""
    start, axis = segments[i, dimension], segments[i, 3 + dimension]
    near = start - axis * reach * segments[i, 6]
    far = start + axis * (reach + 1.0) * segments[i, 6]
    margin = reach * segments[i, 7] * math.sqrt(max(0.0, 1.0 - axis * axis))
    return math.floor(min(near, far) - margin), math.floor(max(near, far) + margin) + 1


@njit("UniTuple(int64, 2)(float64[:,::1], int64, float64, int64)", cache=True, nogil=True)
def strip_of(segments: Floats, i: int, reach: float, x: int) -> tuple[int, int]:
    """Return [first, end) y where the shadow of segment i's cylinder on the xy plane crosses x."""
    ax, ay = segments[i, 3], segments[i, 4]
    if abs(ax) < 1e-6:
        return -(1 << 40), 1 << 40
    middle = segments[i, 1] + ay / ax * (x + 0.5 - segments[i, 0])
    margin = abs(reach * segments[i, 7] * math.sqrt(ax * ax + ay * ay) / ax)
    return math.floor(middle - margin - 0.5), math.floor(middle + margin - 0.5) + 2


@njit("UniTuple(int64, 2)(float64[:,::1], int64, float64, int64, int64)", cache=True, nogil=True)
def row_range(segments: Floats, i: int, reach: float, x: int, y: int) -> tuple[int, int]:
    """Return [first, end) z of the row of voxel centres (x, y) inside segment i's support box.

    The box is the cylinder d_r <= reach * radius cut to d_l <= reach * length; it contains the
    ellipsoid. Empty rows give first >= end.
    """
    ax, ay, az, length = segments[i, 3], segments[i, 4], segments[i, 5], segments[i, 6]
    wx, wy = x + 0.5 - segments[i, 0], y + 0.5 - segments[i, 1]
    across = wx * ax + wy * ay
    # |w|^2 - (w . axis)^2 <= (reach * radius)^2 is a quadratic a z^2 + 2 b z + c <= 0 in z.
    a = 1.0 - az * az
    b = -across * az
    c = wx * wx + wy * wy - across * across - (reach * segments[i, 7]) ** 2
    low, high = -1e9, 1e9
    if a > 1e-12:
        root = b * b - a * c
        if root < 0.0:
            return 0, 0
        low, high = (-b - math.sqrt(root)) / a, (-b + math.sqrt(root)) / a
    elif c > 0.0:
        return 0, 0
    if abs(az) > 1e-12:
        near = (-reach * length - across) / az
        far = ((reach + 1.0) * length - across) / az
        low, high = max(low, min(near, far)), min(high, max(near, far))
    elif not -reach * length <= across <= (reach + 1.0) * length:
        return 0, 0
    return math.ceil(segments[i, 2] + low - 0.5), math.floor(segments[i, 2] + high - 0.5) + 1


@njit("int32[:,::1](int32[:,::1], int64)", cache=True, nogil=True)
def resized(rows: Int32s, length: int) -> Int32s:
    """Return a copy of rows (R, 5) with room for `length`, or their first ones.

    Loops, here and below: assigning to slices takes the compiler seconds.
    """
    copy = np.empty((length, 5), dtype=np.int32)
    for r in range(min(len(rows), length)):
        for i in range(5):
            copy[r, i] = rows[r, i]
    return copy


@njit("int32[:,::1](float64[:,::1], float64)", cache=True, nogil=True)
def rows_of_segments(segments: Floats, reach: float) -> Int32s:
    """Return (R, 5) int32 rows (segment, x, y, first z, end z) that cover all supports."""
    count = 0
    rows = np.empty((1 << 15, 5), dtype=np.int32)
    for i in range(len(segments)):
        x0, x1 = box_of(segments, i, reach, 0)
        box_y0, box_y1 = box_of(segments, i, reach, 1)
        for x in range(x0, x1):
            y0, y1 = strip_of(segments, i, reach, x)
            for y in range(max(y0, box_y0), min(y1, box_y1)):
                z0, z1 = row_range(segments, i, reach, x, y)
                while z0 < z1:
                    if count == len(rows):
                        rows = resized(rows, 2 * count)
                    end = min(z1, z0 + LONGEST_ROW)
                    rows[count, 0], rows[count, 1], rows[count, 2] = i, x, y
                    rows[count, 3], rows[count, 4] = z0, end
                    count += 1
                    z0 = end
    return resized(rows, count)


@njit("int64(float64[:,::1], int64, int32[:,::1], int64)", cache=True, nogil=True)
def rows_on_segment(segments: Floats, segment: int, rows: Int32s, count: int) -> int:
    """Write a row for each voxel a segment passes through (Amanatides and Woo's traversal).

    `rows` must have room; returns the new count.
    """
    voxel, last = np.empty(3, dtype=np.int64), np.empty(3, dtype=np.int64)
    to_next, per_voxel = np.empty(3), np.empty(3)
    steps = 0
    for i in range(3):
        start = segments[segment, i]
        end = start + segments[segment, 6] * segments[segment, 3 + i]
        voxel[i], last[i] = math.floor(start), math.floor(end)
        to_next[i] = per_voxel[i] = math.inf
        steps += abs(last[i] - voxel[i])
        if last[i] != voxel[i]:
            border = voxel[i] + 1 if end > start else voxel[i]
            to_next[i] = (border - start) / (end - start)
            per_voxel[i] = 1.0 / abs(end - start)
    for step in range(steps + 1):
        if step > 0:
            i = 0
            for j in range(1, 3):
                if to_next[j] < to_next[i]:
                    i = j
            voxel[i] += 1 if last[i] > voxel[i] else -1
            to_next[i] = math.inf if voxel[i] == last[i] else to_next[i] + per_voxel[i]
        rows[count, 0], rows[count, 1], rows[count, 2] = segment, voxel[0], voxel[1]
        rows[count, 3], rows[count, 4] = voxel[2], voxel[2] + 1
        count += 1
    return count


@njit("int32[:,::1](float64[:,::1])", cache=True, nogil=True)
def rows_on_segments(segments: Floats) -> Int32s:
    """Return (R, 5) rows of one voxel each: those that the segments pass through, in order."""
    room = 0
    for i in range(len(segments)):
        room += 4 + int(1.8 * segments[i, 6])  # at most sqrt(3) a voxel, and 3 for the ends
    rows = np.empty((room, 5), dtype=np.int32)
    count = 0
    for i in range(len(segments)):
        count = rows_on_segment(segments, i, rows, count)
    return resized(rows, count)


@njit(
    "void(float64[::1], float64[::1], int64[::1], int64[::1], int64, float64)",
    cache=True,
    nogil=True,
)
def units_of(
    squared: Floats, confidence: Floats, bits: Ints, units: Ints, count: int, k: float
) -> None:
    """Write round(-log(1 - p_o)) in map units; `bits` must be a view of `squared`.

    p_o = c (1 - sqrt(squared) / k), not below 0 (paper eq. 1). 1 - p_o = m 2^e with m in
    [sqrt(1/2), sqrt(2)); log m = 2 artanh((m - 1) / (m + 1)) as a series. Loops without branches
    or calls, which compilers turn into vector instructions.
    """
    for i in range(count):
        p = confidence[i] - confidence[i] * math.sqrt(squared[i]) / k
        squared[i] = 1.0 - max(p, 0.0)
    for i in range(count):
        exponent = (bits[i] - 0x3FE6A09E667F3BCD) >> 52
        units[i] = exponent
        bits[i] -= exponent << 52
    for i in range(count):
        s = (squared[i] - 1.0) / (squared[i] + 1.0)
        t = s * s
        series = 1.0 / 19.0
        series = series * t + 1.0 / 17.0
        series = series * t + 1.0 / 15.0
        series = series * t + 1.0 / 13.0
        series = series * t + 1.0 / 11.0
        series = series * t + 1.0 / 9.0
        series = series * t + 1.0 / 7.0
        series = series * t + 1.0 / 5.0
        series = series * t + 1.0 / 3.0
        log_m = 2.0 * s + 2.0 * s * t * series
        nat = -(log_m + units[i] * 0.6931471805599453)
        units[i] = int(nat * UNITS_PER_NAT + 0.5)


@njit(
    "int64(float64[:,::1], int32[:,::1], int64, float64[::1], float64[::1], int64)",
    cache=True,
    nogil=True,
)
def measure_row(
    segments: Floats, rows: Int32s, row: int, squared: Floats, confidence: Floats, at: int
) -> int:
    """Write (d_l / l)^2 + (d_r / r)^2 and c of a row's voxels from `at` on; return the end."""
    i = rows[row, 0]
    ax, ay, az, length = segments[i, 3], segments[i, 4], segments[i, 5], segments[i, 6]
    per_length, per_radius = 1.0 / length, 1.0 / segments[i, 7]
    wx = rows[row, 1] + 0.5 - segments[i, 0]
    wy = rows[row, 2] + 0.5 - segments[i, 1]
    wz = rows[row, 3] + 0.5 - segments[i, 2]
    count = rows[row, 4] - rows[row, 3]
    for z in range(count):
        along = wx * ax + wy * ay + (wz + z) * az
        # The perpendicular part itself, since |w|^2 - along^2 cancels for long thin segments.
        rx, ry, rz = wx - along * ax, wy - along * ay, wz + z - along * az
        axial = max(0.0, max(-along, along - length)) * per_length
        radial = (rx * rx + ry * ry + rz * rz) * per_radius * per_radius
        squared[at + z] = axial * axial + radial
        confidence[at + z] = segments[i, 8]
    return int(at + count)


@njit(
    "int64(int32[:,::1], int64, int64, int64[::1], int64, int32[::1], uint8[::1], uint8[::1],"
    " uint8[::1], int32[:,:,::1], int64[::1], int32[::1], int64)",
    cache=True,
    nogil=True,
)
def add_to_rows(
    rows: Int32s,
    first: int,
    end: int,
    units: Ints,
    sign: int,
    sums: Int32s,
    levels: Bytes,
    level_table: Bytes,
    marks: Bytes,
    top: Int32s,
    origin: Ints,
    changed: Int32s,
    count: int,
) -> int:
    """Add units to the voxels of rows [first, end); note once whose level changes; new count."""
    at = 0
    highest = len(level_table) - 1
    for r in range(first, end):
        slot = 0
        for z in range(rows[r, 3], rows[r, 4]):
            if slot == 0 or z & 7 == 0:
                slot = slot_of(top, origin, rows[r, 1], rows[r, 2], z)
            else:
                slot += 1
            amount = units[at]
            at += 1
            if amount == 0:
                continue
            total = min(sums[slot] + sign * amount, MAX_SUM)
            sums[slot] = total
            level = np.uint8(0)
            if total > 0:
                level = level_table[min(total >> LEVEL_SHIFT, highest)]
            if level != levels[slot]:
                levels[slot] = level
                if marks[slot] == 0:
                    marks[slot] = 1
                    changed[count] = slot
                    count += 1
    return count


@njit("void(int64[::1], float64[::1], int64)", cache=True, nogil=True)
def rest_of(units: Ints, confidence: Floats, count: int) -> None:
    """Replace units by what is missing from them to p_o = c (rule 1)."""
    for i in range(count):
        units[i] = int(-math.log1p(-confidence[i]) * UNITS_PER_NAT + 0.5) - units[i]


@njit(
    "int32[::1](float64[:,::1], float64, int32[:,::1], boolean, int64, int32[::1], uint8[::1],"
    " uint8[::1], uint8[::1], int32[:,:,::1], int64[::1])",
    cache=True,
    nogil=True,
)
def accumulate(
    segments: Floats,
    k: float,
    rows: Int32s,
    rest: bool,
    sign: int,
    sums: Int32s,
    levels: Bytes,
    level_table: Bytes,
    marks: Bytes,
    top: Int32s,
    origin: Ints,
) -> Int32s:
    """Add (sign 1) or take off (-1) what segments tell about the voxels of their rows.

    That is -log(1 - p_o), or with `rest` what is left from there to p_o = c: rule 1, for rows on
    the segments. Returns the slots whose level changed and that were not marked yet; they are
    marked now.
    """
    voxels = 0
    for r in range(len(rows)):
        voxels += rows[r, 4] - rows[r, 3]
    changed = np.empty(voxels, dtype=np.int32)
    squared, confidence = np.zeros(BATCH), np.zeros(BATCH)
    bits, units = squared.view(np.int64), np.zeros(BATCH, dtype=np.int64)
    found = first = filled = 0
    for r in range(len(rows) + 1):
        if r == len(rows) or filled + rows[r, 4] - rows[r, 3] > BATCH:
            units_of(squared, confidence, bits, units, filled, k)
            if rest:
                rest_of(units, confidence, filled)
            found = add_to_rows(
                rows, first, r, units, sign, sums, levels, level_table, marks, top, origin,
                changed, found,
            )  # fmt: skip
            first, filled = r, 0
        if r < len(rows):
            filled = measure_row(segments, rows, r, squared, confidence, filled)
    result = np.empty(found, dtype=np.int32)
    for i in range(found):
        result[i] = changed[i]
    return result
