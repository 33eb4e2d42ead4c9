"""Heaps in arrays, the least first: of numbers (N,), or of rows of three numbers (N, 3).

Entry 0 holds how many there are, entry 1 is the least. Compilers take seconds over `heapq` on
tuples. Room must be there: nothing is returned, so nothing is counted references of.
"""

import numpy as np
from numpy.typing import NDArray

from canopy_skel.kernels.compiled import inner

Ints = NDArray[np.int64]


@inner("void(int64[::1], int64)")
def push(heap: Ints, entry: int) -> None:
    """Add a number."""
    at = heap[0] + 1
    heap[0] = at
    while at > 1 and entry < heap[at >> 1]:
        heap[at] = heap[at >> 1]
        at >>= 1
    heap[at] = entry


@inner("void(int64[::1])")
def pop(heap: Ints) -> None:
    """Take the least number away."""
    count = heap[0] - 1
    heap[0] = count
    last, at, below = heap[count + 1], 1, 2
    while below <= count:
        if below < count and heap[below + 1] < heap[below]:
            below += 1
        if heap[below] >= last:
            break
        heap[at] = heap[below]
        at, below = below, 2 * below
    heap[at] = last


@inner("boolean(int64[:,::1], int64, int64, int64, int64)")
def is_before(heap: Ints, i: int, a: int, b: int, c: int) -> bool:
    """Say whether row i comes before (a, b, c)."""
    if heap[i, 0] != a:
        return bool(heap[i, 0] < a)
    if heap[i, 1] != b:
        return bool(heap[i, 1] < b)
    return bool(heap[i, 2] < c)


@inner("void(int64[:,::1], int64, int64, int64)")
def push_row(heap: Ints, a: int, b: int, c: int) -> None:
    """Add the row (a, b, c)."""
    at = heap[0, 0] + 1
    heap[0, 0] = at
    while at > 1 and not is_before(heap, at >> 1, a, b, c):
        for j in range(3):
            heap[at, j] = heap[at >> 1, j]
        at >>= 1
    heap[at, 0], heap[at, 1], heap[at, 2] = a, b, c


@inner("void(int64[:,::1])")
def pop_row(heap: Ints) -> None:
    """Take the least row away."""
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


@inner("int64[:,::1](int64[:,::1], int64)")
def with_room(heap: Ints, more: int) -> Ints:
    """Return a heap of rows with room for more, a copy if it had none."""
    count = heap[0, 0] + 1
    if count + more <= len(heap):
        return heap
    copy = np.empty((2 * (count + more), 3), dtype=np.int64)
    for i in range(count):
        for j in range(3):
            copy[i, j] = heap[i, j]
    return copy
