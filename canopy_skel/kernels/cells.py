"""One number per cell of a grid, so that points are found by where they are."""

import math

import numpy as np
from numpy.typing import NDArray

from canopy_skel.kernels.compiled import inner

Ints = NDArray[np.int64]
BOX = 7
"""Numbers that a box of cells takes: first and last in x, y and z, and how many rows it has."""


_BITS, _BITS_Z = 18, 26
"""A row of cells of 4 mm along z reaches as far from base as a camera may stand."""
_LAST, _LAST_Z = (1 << _BITS) - 1, (1 << _BITS_Z) - 1


@inner("int64(int64, int64, int64)")
def cell_key(x: int, y: int, z: int) -> int:
    """Return one number per cell; cells in a row along z follow one another.

    Across, numbers come again after 2^18 cells (1 km of 4 mm): cells near one another never share
    one, wherever base is, so that no point is found twice.
    """
    across = ((x + (_LAST + 1) // 2) & _LAST) << _BITS | ((y + (_LAST + 1) // 2) & _LAST)
    return across << _BITS_Z | ((z + (_LAST_Z + 1) // 2) & _LAST_Z)


@inner("int64(int64[::1], int64)")
def first_at(keys: Ints, key: int) -> int:
    """Return the first place of ascending keys that is no less than one."""
    low, high = 0, len(keys)
    while low < high:
        middle = (low + high) // 2
        if keys[middle] < key:
            low = middle + 1
        else:
            high = middle
    return low


@inner("int64[::1]()")
def no_box() -> Ints:
    """Return a box that no cells are in."""
    box = np.zeros(BOX, dtype=np.int64)
    box[0] = 1
    return box


@inner("int64(float64, float64)")
def most_rows(reach_m: float, cell_m: float) -> int:
    """Return of how many rows along z the cells within reach of a place can be, at most."""
    across = math.floor(2.0 * reach_m / cell_m) + 3
    return across * across


@inner("int64(float64, float64, float64, float64, float64, int64[::1], int64[::1], int64[:,::1])")
def rows_around(
    px: float,
    py: float,
    pz: float,
    reach_m: float,
    cell_m: float,
    keys: Ints,
    box: Ints,
    rows: Ints,
) -> int:
    """Write first and end in ascending keys of each row of cells within reach; return how many.

    `box` (BOX,), `no_box` before the first call, and `rows` are kept from call to call: places in
    the same cells have the same rows, so that it pays to ask for them one after the other.
    """
    x0, x1 = math.floor((px - reach_m) / cell_m), math.floor((px + reach_m) / cell_m)
    y0, y1 = math.floor((py - reach_m) / cell_m), math.floor((py + reach_m) / cell_m)
    z0, z1 = math.floor((pz - reach_m) / cell_m), math.floor((pz + reach_m) / cell_m)
    same = box[0] == x0 and box[1] == x1 and box[2] == y0 and box[3] == y1
    if same and box[4] == z0 and box[5] == z1:
        return int(box[6])
    count = 0
    for x in range(x0, x1 + 1):
        for y in range(y0, y1 + 1):
            first, high = first_at(keys, cell_key(x, y, z0)), cell_key(x, y, z1)
            end = first
            while end < len(keys) and keys[end] <= high:
                end += 1
            if end > first:
                rows[count, 0], rows[count, 1] = first, end
                count += 1
    box[0], box[1], box[2], box[3], box[4], box[5], box[6] = x0, x1, y0, y1, z0, z1, count
    return count
