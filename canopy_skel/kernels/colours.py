"""Colours of a picture in bins of Lab, 8 levels of lightness and 4 of either colour in each."""

import numpy as np
from numpy.typing import NDArray

from canopy_skel.kernels.compiled import inner, kernel

Pixels = NDArray[np.uint8]
Flags = NDArray[np.bool_]
Floats32 = NDArray[np.float32]
BINS = 1 << 17


@inner("int64(uint8[:,:,::1], int64, int64)")
def bin_of(lab: Pixels, v: int, u: int) -> int:
    """Return the bin of a pixel of a picture (H, W, 3)."""
    return int(lab[v, u, 0]) >> 3 << 12 | int(lab[v, u, 1]) >> 2 << 6 | int(lab[v, u, 2]) >> 2


@kernel("int64[:,::1](uint8[:,:,::1], boolean[:,::1], boolean[:,::1])")
def count_colours(lab: Pixels, chosen: Flags, split: Flags) -> NDArray[np.int64]:
    """Count the chosen pixels (H, W) of a picture (H, W, 3) in bins (2, BINS).

    Those where `split` (H, W) says so come into the first row, the others into the second.
    """
    counts = np.zeros((3, BINS), dtype=np.int64)
    for v in range(lab.shape[0]):
        for u in range(lab.shape[1]):
            # All are counted, some for nothing: no branch to guess wrong.
            row = (0 if split[v, u] else 1) if chosen[v, u] else 2
            counts[row, bin_of(lab, v, u)] += 1
    return counts[:2]


@kernel("float32[:,::1](uint8[:,:,::1], float32[::1])")
def look_up(lab: Pixels, table: Floats32) -> Floats32:
    """Return what a table (BINS,) says of every pixel of a picture (H, W, 3)."""
    found = np.empty(lab.shape[:2], dtype=np.float32)
    for v in range(lab.shape[0]):
        for u in range(lab.shape[1]):
            found[v, u] = table[bin_of(lab, v, u)]
    return found
