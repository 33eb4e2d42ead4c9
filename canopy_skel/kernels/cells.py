"""One number per cell of a grid, so that points are found by where they are."""

import numpy as np
from numpy.typing import NDArray

from canopy_skel.kernels.compiled import inner


@inner("int64(int64, int64, int64)")
def cell_key(x: int, y: int, z: int) -> int:
    """Return one number per cell; cells in a row along z follow one another."""
    return ((x + 1048576) << 42) | ((y + 1048576) << 21) | (z + 1048576)


@inner("int64(int64[::1], int64)")
def first_at(keys: NDArray[np.int64], key: int) -> int:
    """Return the first place of ascending keys that is no less than one."""
    low, high = 0, len(keys)
    while low < high:
        middle = (low + high) // 2
        if keys[middle] < key:
            low = middle + 1
        else:
            high = middle
    return low
