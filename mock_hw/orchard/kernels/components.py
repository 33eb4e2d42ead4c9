"""Connected components of equal labels."""

import numpy as np
from numba import njit
from numpy.typing import NDArray

I32 = NDArray[np.int32]


@njit(cache=True)
def _root(parent: I32, i: int) -> int:
    while parent[i] != i:
        parent[i] = parent[parent[i]]
        i = parent[i]
    return i


@njit(cache=True, nogil=True)
def components(label: I32, out: I32) -> int:
    """Number the 8-connected regions of equal label >= 0 in reading order; return their count.

    label: (H, W). out: (H, W), gets 0, 1, … and -1 where the label is negative.
    """
    height, width = label.shape
    parent = np.arange(height * width).astype(np.int32)
    for v in range(height):
        for u in range(width):
            if label[v, u] < 0:
                continue
            here = v * width + u
            for dv, du in ((0, -1), (-1, -1), (-1, 0), (-1, 1)):
                y, x = v + dv, u + du
                if y < 0 or x < 0 or x >= width or label[y, x] != label[v, u]:
                    continue
                a, b = _root(parent, here), _root(parent, y * width + x)
                parent[max(a, b)] = min(a, b)
    count = 0
    for v in range(height):
        for u in range(width):
            out[v, u] = -1
            if label[v, u] >= 0:
                here = v * width + u
                top = _root(parent, here)
                if top == here:
                    out[v, u] = count
                    count += 1
                else:
                    out[v, u] = out[top // width, top % width]
    return count
