"""Union-find: what is connected, and which edges connect it (Kruskal)."""

import numpy as np
from numpy.typing import NDArray

from canopy_skel.kernels.compiled import inner, kernel

Ints = NDArray[np.int64]
Int32s = NDArray[np.int32]


@inner("int64(int32[::1], int64)")
def root_of(parent: Int32s, label: int) -> int:
    """Return the representative of a component, shortening the way to it."""
    while parent[label] != label:
        parent[label] = parent[parent[label]]
        label = int(parent[label])
    return label


@kernel("int64[::1](int64[:,::1], int32[::1])")
def span(ends: Ints, parent: Int32s) -> Ints:
    """Return which edges (N, 3) sorted by cost, of each anything and two labels, span a forest.

    `parent` is the union-find of the labels, changed.
    """
    taken = np.empty(len(ends), dtype=np.int64)
    count = 0
    for i in range(len(ends)):
        a, b = root_of(parent, ends[i, 1]), root_of(parent, ends[i, 2])
        if a != b:
            parent[max(a, b)] = min(a, b)
            taken[count] = i
            count += 1
    return taken[:count].copy()
