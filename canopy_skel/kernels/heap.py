"""A heap of rows of three numbers, the least first, in an array.

Row 0 holds how many there are, row 1 the least. Compilers take seconds over `heapq` on tuples.
"""

import numpy as np
from numba import njit
from numpy.typing import NDArray

Ints = NDArray[np.int64]


@njit("int64[:,::1](int64[:,::1], int64)", cache=True, nogil=True)
def roomy(heap: Ints, length: int) -> Ints:
    """Return a copy with room for `length` rows."""
    copy = np.empty((length, 3), dtype=np.int64)
    for i in range(heap[0, 0] + 1):
        for j in range(3):
            copy[i, j] = heap[i, j]
    return copy


@njit("boolean(int64[:,::1], int64, int64, int64, int64)", cache=True, nogil=True)
def is_before(heap: Ints, i: int, a: int, b: int, c: int) -> bool:
    """Say whether row i comes before (a, b, c)."""
    if heap[i, 0] != a:
        return bool(heap[i, 0] < a)
    if heap[i, 1] != b:
        return bool(heap[i, 1] < b)
    return bool(heap[i, 2] < c)


@njit("int64[:,::1](int64[:,::1], int64, int64, int64)", cache=True, nogil=True)
def push(heap: Ints, a: int, b: int, c: int) -> Ints:
    """Add (a, b, c); return the heap, a larger one if need be."""
    at = heap[0, 0] + 1
    if at == len(heap):
        heap = roomy(heap, 2 * len(heap))
    heap[0, 0] = at
    while at > 1 and not is_before(heap, at >> 1, a, b, c):
        for j in range(3):
            heap[at, j] = heap[at >> 1, j]
        at >>= 1
    heap[at, 0], heap[at, 1], heap[at, 2] = a, b, c
    return heap


@njit("void(int64[:,::1])", cache=True, nogil=True)
def pop(heap: Ints) -> None:
    """Take the least away."""
    count = heap[0, 0] - 1
    heap[0, 0] = count
    a, b, c = heap[count + 1, 0], heap[count + 1, 1], heap[count + 1, 2]
    at, below = 1, 2
    while below <= count:
        if below < count and is_before(
            heap, below + 1, heap[below, 0], heap[below, 1], heap[below, 2]
        ):
            below += 1
        if not is_before(heap, below, a, b, c):
            break
        for j in range(3):
            heap[at, j] = heap[below, j]
        at, below = below, 2 * below
    heap[at, 0], heap[at, 1], heap[at, 2] = a, b, c
