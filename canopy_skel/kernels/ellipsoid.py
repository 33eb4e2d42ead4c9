"""Which voxels a segment's likelihood ellipsoid covers (paper eq. 1), as runs.

Voxel (x, y, z) covers [x, x + 1) voxel sizes in base; all lengths here are in voxels. A segment is
a row (9,): start, unit axis, length, radius, confidence. A run is eight voxels in a row along z in
one block, slots 8 run to 8 run + 7.

In a row along z, (d_r / r)^2 = gap + slide^2: gap is constant, where the row and the axis are
closest, and slide linear in z. The place along the segment, 0 at its start and 1 at its end, is
linear too. So nothing cancels for long thin segments, and what a voxel gets is a function of the
segment and the voxel alone.
"""

import math

import numpy as np
from numpy.typing import NDArray

from canopy_skel.kernels.compiled import inner, kernel
from canopy_skel.kernels.grid import RUN, slot_of

Floats = NDArray[np.float64]
Float32s = NDArray[np.float32]
Ints = NDArray[np.int64]
Int32s = NDArray[np.int32]
Line = tuple[float, float, float]
Shape = tuple[float, float, float, float, float, float, float, float]


@inner("UniTuple(int64, 2)(float64[:,::1], int64, float64, int64)")
def box_of(segments: Floats, i: int, reach: float, dimension: int) -> tuple[int, int]:
    """Return [first, end) voxel of segment i's support along x (0), y (1) or z (2)."""
    start, axis = segments[i, dimension], segments[i, 3 + dimension]
    near = start - axis * reach * segments[i, 6]
    far = start + axis * (reach + 1.0) * segments[i, 6]
    margin = reach * segments[i, 7] * math.sqrt(max(0.0, 1.0 - axis * axis))
    return math.floor(min(near, far) - margin), math.floor(max(near, far) + margin) + 1


@kernel("int64[:,::1](float64[:,::1], float64)")
def bounds_of_segments(segments: Floats, reach: float) -> Ints:
    """Return the first and the end block (2, 3) of all supports."""
    span = np.empty((2, 3), dtype=np.int64)
    for j in range(3):
        for i in range(len(segments)):
            first, end = box_of(segments, i, reach, j)
            first, end = first >> 3, ((end - 1) >> 3) + 1
            span[0, j] = first if i == 0 else min(span[0, j], first)
            span[1, j] = end if i == 0 else max(span[1, j], end)
    return span


@inner("UniTuple(int64, 2)(float64[:,::1], int64, float64, int64)")
def strip_of(segments: Floats, i: int, reach: float, x: int) -> tuple[int, int]:
    """Return [first, end) y where the shadow of segment i's cylinder on the xy plane crosses x."""
    first, end = box_of(segments, i, reach, 1)
    ax, ay = segments[i, 3], segments[i, 4]
    if abs(ax) < 1e-6:
        return first, end
    middle = segments[i, 1] + ay / ax * (x + 0.5 - segments[i, 0])
    margin = abs(reach * segments[i, 7] * math.sqrt(ax * ax + ay * ay) / ax)
    low, high = math.floor(middle - margin - 0.5), math.floor(middle + margin - 0.5) + 2
    return max(first, low), min(end, high)


@inner("UniTuple(float64, 8)(float64[:,::1], int64)", error_model="numpy")
def shape_of(segments: Floats, i: int) -> Shape:
    """Return what all rows along a segment share.

    The sine of its axis with z, what a step in z adds to the slide and to the place, what a length
    and a radius are divided by, and the inverses of the first three, 0 for that of 0.
    """
    tilt = math.sqrt(segments[i, 3] * segments[i, 3] + segments[i, 4] * segments[i, 4])
    per_length, per_radius = 1.0 / segments[i, 6], 1.0 / segments[i, 7]
    place_step = segments[i, 5] * per_length
    per_tilt, per_slide, per_place = 0.0, 0.0, 0.0
    if tilt > 1e-12:
        per_tilt, per_slide = 1.0 / tilt, segments[i, 7] / tilt
    else:
        tilt = 0.0
    if abs(place_step) > 1e-12:
        per_place = 1.0 / place_step
    return (
        tilt, tilt * per_radius, place_step, per_length, per_radius, per_tilt, per_slide, per_place
    )  # fmt: skip


@inner("UniTuple(float64, 3)(float64[:,::1], int64, UniTuple(float64, 8), int64, int64)")
def line_of(segments: Floats, i: int, shape: Shape, x: int, y: int) -> Line:
    """Return gap, and slide and place at z = 0, of the row of voxels at x, y."""
    tilt, _, _, per_length, per_radius, per_tilt, _, _ = shape
    ax, ay, az = segments[i, 3], segments[i, 4], segments[i, 5]
    wx, wy, wz = x + 0.5 - segments[i, 0], y + 0.5 - segments[i, 1], 0.5 - segments[i, 2]
    across = wx * ax + wy * ay
    place = (across + wz * az) * per_length
    if tilt == 0.0:
        return (wx * wx + wy * wy) * per_radius * per_radius, 0.0, place
    gap = (wx * ay - wy * ax) * per_tilt * per_radius
    return gap * gap, (wz * tilt - across * per_tilt * az) * per_radius, place


@inner("UniTuple(int64, 2)(UniTuple(float64, 3), UniTuple(float64, 8), float64)")
def reach_of(line: Line, shape: Shape, k: float) -> tuple[int, int]:
    """Return [first, end) z of the voxels of a row that may lie inside the support.

    Empty rows give first >= end.
    """
    gap, slide, place = line
    _, _, place_step, _, _, _, per_slide, per_place = shape
    low, high, left = -1e9, 1e9, k * k - gap
    if per_slide > 0.0:
        # How far the row stays beyond the ends narrows it, as it does the ellipsoid.
        middle, spread = place - slide * per_slide * place_step, k * per_slide * abs(place_step)
        beyond = max(0.0, max(-middle, middle - 1.0) - spread)
        left -= beyond * beyond
    if left <= 0.0:
        return 0, 0
    if per_slide > 0.0:
        root = math.sqrt(left)
        low, high = (-root - slide) * per_slide, (root - slide) * per_slide
    if per_place != 0.0:
        near, far = (-k - place) * per_place, (k + 1.0 - place) * per_place
        low, high = max(low, min(near, far)), min(high, max(near, far))
    elif not -k <= place <= k + 1.0:
        return 0, 0
    return math.ceil(low), math.floor(high) + 1


@kernel("int64(float64[:,::1], float64)", error_model="numpy")
def room_for(segments: Floats, k: float) -> int:
    """Return how many runs the supports have at most."""
    room = 0
    for i in range(len(segments)):
        low, high = box_of(segments, i, k, 2)
        chord, per_slide = float(high - low), shape_of(segments, i)[6]
        if per_slide > 0.0:
            chord = min(chord, 2.0 * k * per_slide)
        first, end = box_of(segments, i, k, 0)
        for x in range(first, end):
            y0, y1 = strip_of(segments, i, k, x)
            room += max(0, y1 - y0) * (2 + int(chord) // RUN)
    return room


@kernel(
    "int64(float64[:,::1], float64, int32[:,:,::1], int64[::1], int64, int64[::1], int32[::1],"
    " float32[:,::1])"
)
def runs_of_segments(
    segments: Floats,
    k: float,
    top: Int32s,
    origin: Ints,
    blocks: int,
    starts: Ints,
    runs: Int32s,
    terms: Float32s,
) -> int:
    """Write the runs that cover all supports, and gap, slide and place (3, R) at their first voxel.

    Those of segment i are starts[i] up to starts[i + 1]. Blocks that are touched first are numbered
    from `blocks` on in `top`, which must span the supports; returns the new number.
    """
    count = 0
    for i in range(len(segments)):
        starts[i] = count
        shape = shape_of(segments, i)
        x0, x1 = box_of(segments, i, k, 0)
        for x in range(x0, x1):
            y0, y1 = strip_of(segments, i, k, x)
            bx = (x >> 3) - origin[0]
            for y in range(y0, y1):
                line = line_of(segments, i, shape, x, y)
                z0, z1 = reach_of(line, shape, k)
                by, inside = (y >> 3) - origin[1], (x & 7) << 3 | (y & 7)
                for bz in range(z0 >> 3, ((z1 - 1) >> 3) + 1 if z0 < z1 else z0 >> 3):
                    block = int(top[bx, by, bz - origin[2]])
                    if block == 0:
                        block, blocks = blocks, blocks + 1
                        top[bx, by, bz - origin[2]] = block
                    runs[count] = block << 6 | inside
                    terms[0, count] = line[0]
                    terms[1, count] = line[1] + shape[1] * (bz << 3)
                    terms[2, count] = line[2] + shape[2] * (bz << 3)
                    count += 1
    starts[len(segments)] = count
    return blocks


@kernel(
    "int64(float64[:,::1], int32[:,::1], int32[:,:,::1], int64[::1], int64, int64[::1], int32[::1],"
    " float32[:,::1], int8[::1])"
)
def runs_on_segments(
    segments: Floats,
    rows: Int32s,
    top: Int32s,
    origin: Ints,
    blocks: int,
    starts: Ints,
    runs: Int32s,
    terms: Float32s,
    places: NDArray[np.int8],
) -> int:
    """Do the same for rows of one voxel (R, 5), in order; write its place in the run as well."""
    at = 0
    for i in range(len(segments)):
        starts[i] = at
        shape = shape_of(segments, i)
        while at < len(rows) and rows[at, 0] == i:
            x, y, z = int(rows[at, 1]), int(rows[at, 2]), int(rows[at, 3])
            bx, by, bz = (x >> 3) - origin[0], (y >> 3) - origin[1], (z >> 3) - origin[2]
            if top[bx, by, bz] == 0:
                top[bx, by, bz] = blocks
                blocks += 1
            runs[at], places[at] = slot_of(top, origin, x, y, z) >> 3, z & 7
            line = line_of(segments, i, shape, x, y)
            terms[0, at] = line[0]
            terms[1, at] = line[1] + shape[1] * (z & ~7)
            terms[2, at] = line[2] + shape[2] * (z & ~7)
            at += 1
    starts[len(segments)] = at
    return blocks


@inner("int32[:,::1](int32[:,::1], int64)")
def resized(rows: Int32s, length: int) -> Int32s:
    """Return a copy of rows with room for `length`, or their first ones.

    Loops, here and below: assigning to slices takes the compiler seconds.
    """
    copy = np.empty((length, rows.shape[1]), dtype=np.int32)
    for r in range(min(len(rows), length)):
        for i in range(rows.shape[1]):
            copy[r, i] = rows[r, i]
    return copy


@inner("int64(float64[:,::1], int64, int32[:,::1], int64)")
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


@kernel("int32[:,::1](float64[:,::1])")
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
