"""Medians."""

import math

import numpy as np
from numpy.typing import NDArray

from canopy_skel.kernels.compiled import inner

Floats = NDArray[np.float64]


@inner("float64(float64[::1])")
def median_of(values: Floats) -> float:
    """Return the median of values, whose order is lost (Hoare's selection)."""
    n = len(values)
    low, high, middle = 0, n - 1, n // 2
    while low < high:
        pivot = values[(low + high) // 2]
        i, j = low, high
        while i <= j:
            while values[i] < pivot:
                i += 1
            while values[j] > pivot:
                j -= 1
            if i <= j:
                values[i], values[j] = values[j], values[i]
                i += 1
                j -= 1
        if middle <= j:
            high = j
        elif middle >= i:
            low = i
        else:
            break
    if n % 2:
        return float(values[middle])
    below = -math.inf
    for i in range(middle):
        below = max(below, values[i])
    return float(0.5 * (below + values[middle]))
