"""What is connected in a picture, of which only the runs of its rows are looked at."""

import numpy as np
from numpy.typing import NDArray

from canopy_skel.kernels.compiled import inner, kernel

Ints = NDArray[np.int64]


@inner("int64(int64[::1], int64)")
def first_of(parent: Ints, run: int) -> int:
    """Return the first run of a component, shortening the way to it."""
    while parent[run] != run:
        parent[run] = parent[parent[run]]
        run = parent[run]
    return run


@kernel("int64[::1](int64[::1], int64[::1], int64)")
def connected_runs(starts: Ints, ends: Ints, width: int) -> Ints:
    """Return of each run (R,) the first run that it is connected with, corners included.

    Run i is the pixels [starts[i], ends[i]) of a picture whose rows of `width` pixels, the last of
    them empty, follow one another; runs come in that order.
    """
    parent = np.arange(len(starts))
    above = 0
    for i in range(len(starts)):
        low, high = starts[i] - width, ends[i] - width
        while ends[above] < low:
            above += 1
        k = above
        while k < i and starts[k] <= high:
            if ends[k] >= low:
                a, b = first_of(parent, k), first_of(parent, i)
                parent[max(a, b)] = min(a, b)
            k += 1
    for i in range(len(parent)):
        parent[i] = first_of(parent, i)
    return parent
