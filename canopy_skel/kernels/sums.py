"""What segments add to the voxels of their runs: integer sums of -log(1 - p_o) (paper eq. 1).

Sums are integers, so the order of segments and views does not matter, to the bit, and what was
added can be taken off again. What is added is worked out in single precision, of which +, *, /,
square root and comparisons alone are used, in loops without branches or calls, which compilers
turn into vector instructions: the same bits on every machine, within one unit of exact.
"""

import math

import numpy as np
from numpy.typing import NDArray

from canopy_skel.kernels.compiled import inner, kernel
from canopy_skel.kernels.grid import RUN

Bytes = NDArray[np.uint8]
Float32s = NDArray[np.float32]
Ints = NDArray[np.int64]
Int32s = NDArray[np.int32]

UNITS_PER_NAT = 65536
"""Fixed point of the map: -log(1 - p) in units of 1/65536 nat."""
MAX_SUM = 1 << 30
"""Sums saturate here (16384 nat): room for one more addition below the int32 limit."""
LEVEL_SHIFT = 6
"""Levels are read off a table at sum >> 6: steps of 1/1024 nat."""
BATCH = 512
"""Runs worked out at a time."""
_ZERO, _ONE, _TWO, _HALF = np.float32(0), np.float32(1), np.float32(2), np.float32(0.5)
_THIRD, _FIFTH, _SEVENTH, _NINTH = (np.float32(1 / n) for n in (3, 5, 7, 9))
_LOG_2, _UNITS = np.float32(math.log(2)), np.float32(UNITS_PER_NAT)
_ROOT_HALF, _MANTISSA = np.int32(0x3F3504F3), np.int32(23)
_SEEN = np.uint8(2)


@inner("void(float32[::1], int32[::1], int32[::1])", error_model="numpy")
def units_of(empty: Float32s, bits: Int32s, units: Int32s) -> None:
    """Write round(-log(empty)) in map units; `bits` must be a view of `empty`, which is lost.

    empty = m 2^e with m in [sqrt(1/2), sqrt(2)); log m = 2 artanh((m - 1) / (m + 1)) as a series.
    """
    for i in range(len(units)):
        exponent = (bits[i] - _ROOT_HALF) >> _MANTISSA
        units[i] = exponent
        bits[i] -= exponent << _MANTISSA
    for i in range(len(units)):
        s = (empty[i] - _ONE) / (empty[i] + _ONE)
        t = s * s
        series = ((_NINTH * t + _SEVENTH) * t + _FIFTH) * t + _THIRD
        log_m = _TWO * s + _TWO * s * (t * series)
        nat = -(log_m + np.float32(units[i]) * _LOG_2)
        units[i] = np.int32(nat * _UNITS + _HALF)


@inner("void(float32[:,::1], int64, int64, float32[::1], float32[::1], int32[::1], int32[::1])")
def measure(
    terms: Float32s,
    first: int,
    count: int,
    slope: Float32s,
    empty: Float32s,
    bits: Int32s,
    units: Int32s,
) -> None:
    """Write what the voxels of runs [first, first + count) get, place in the run by place.

    1 - p_o = 1 - c + c / k sqrt((d_l / l)^2 + (d_r / r)^2), at most 1. `slope`: what a step in z
    adds to slide and place, 1 - c, c / k.
    """
    gap, slide = terms[0, first : first + count], terms[1, first : first + count]
    place = terms[2, first : first + count]
    least, fall = slope[2], slope[3]
    for z in range(RUN):
        slid, along = slope[0] * np.float32(z), slope[1] * np.float32(z)
        out = empty[z * count : (z + 1) * count]
        for r in range(count):
            radial, axial = slide[r] + slid, place[r] + along
            axial = -axial if -axial > axial - _ONE else axial - _ONE
            axial = axial if axial > _ZERO else _ZERO
            q = least + fall * np.float32(math.sqrt(gap[r] + radial * radial + axial * axial))
            out[r] = q if q < _ONE else _ONE
    units_of(empty[: RUN * count], bits[: RUN * count], units[: RUN * count])


@inner(
    "int64(int32[::1], int64, int64, int32[::1], int64, int32[:,::1], uint8[:,::1], int32[::1],"
    " int64)"
)
def add_to_runs(
    runs: Int32s,
    first: int,
    count: int,
    units: Int32s,
    sign: int,
    sums: Int32s,
    marks: Bytes,
    seen: Int32s,
    found: int,
) -> int:
    """Add units to the sums (R, 8) of runs; note each run that gets any once; new count."""
    for r in range(count):
        run = runs[first + r]
        some = 0
        for z in range(RUN):
            amount = units[z * count + r]
            some |= amount
            sums[run, z] = min(sums[run, z] + sign * amount, MAX_SUM)
        if some and marks[run, 0] & _SEEN == 0:
            marks[run, 0] |= _SEEN
            seen[found] = run
            found += 1
    return found


@inner(
    "int64(int32[::1], int8[::1], int64, int64, int32[::1], int64, int64, int32[:,::1],"
    " uint8[:,::1], int32[::1], int64)"
)
def add_rest(
    runs: Int32s,
    places: NDArray[np.int8],
    first: int,
    count: int,
    units: Int32s,
    most: int,
    sign: int,
    sums: Int32s,
    marks: Bytes,
    seen: Int32s,
    found: int,
) -> int:
    """Add what single voxels lack to p_o = c, `most` units (rule 1); note their runs."""
    for r in range(count):
        run, z = runs[first + r], places[first + r]
        sums[run, z] = min(sums[run, z] + sign * (most - units[z * count + r]), MAX_SUM)
        if marks[run, 0] & _SEEN == 0:
            marks[run, 0] |= _SEEN
            seen[found] = run
            found += 1
    return found


@kernel("int32[::1](int32[::1], int32[:,::1], uint8[:,::1], uint8[::1], uint8[:,::1])")
def renew_levels(
    seen: Int32s, sums: Int32s, levels: Bytes, level_table: Bytes, marks: Bytes
) -> Int32s:
    """Read the levels of runs off the table; return the slots that changed and had no mark yet.

    They are marked now.
    """
    changed, count = np.empty(RUN * len(seen), dtype=np.int32), 0
    highest = len(level_table) - 1
    for r in range(len(seen)):
        run = seen[r]
        marks[run, 0] ^= _SEEN
        for z in range(RUN):
            total = sums[run, z]
            level = level_table[min(total >> LEVEL_SHIFT, highest)] if total > 0 else np.uint8(0)
            if level != levels[run, z]:
                levels[run, z] = level
                if marks[run, z] == 0:
                    marks[run, z] = 1
                    changed[count] = run * RUN + z
                    count += 1
    result = np.empty(count, dtype=np.int32)
    for i in range(count):
        result[i] = changed[i]
    return result


@kernel(
    "int64(int64[::1], int32[::1], float32[:,::1], int8[::1], float32[:,::1], int64, int32[:,::1],"
    " uint8[:,::1], int32[::1], int64)"
)
def accumulate(
    starts: Ints,
    runs: Int32s,
    terms: Float32s,
    places: NDArray[np.int8],
    slopes: Float32s,
    sign: int,
    sums: Int32s,
    marks: Bytes,
    seen: Int32s,
    found: int,
) -> int:
    """Add (sign 1) or take off (-1) what segments tell about the voxels of their runs.

    With `places`, what single voxels of them lack to p_o = c (rule 1). Runs that got something are
    appended to the `found` ones in `seen`, each once; returns the new count.
    """
    empty, units = np.empty(RUN * BATCH, np.float32), np.empty(RUN * BATCH, np.int32)
    bits = empty.view(np.int32)
    for i in range(len(slopes)):
        empty[0] = slopes[i, 2]
        units_of(empty[:1], bits[:1], units[:1])
        most = units[0]
        for first in range(starts[i], starts[i + 1], BATCH):
            count = min(BATCH, starts[i + 1] - first)
            measure(terms, first, count, slopes[i], empty, bits, units)
            if len(places):
                found = add_rest(
                    runs, places, first, count, units, most, sign, sums, marks, seen, found
                )
            else:
                found = add_to_runs(runs, first, count, units, sign, sums, marks, seen, found)
    return found
