"""Groups of points that touch, and the shape of each.

Points lie in groups one after the other: those of group i are start[i] up to start[i + 1].
"""

import math

import numpy as np
from numpy.typing import NDArray

from canopy_skel.kernels.axes import diagonalise, scatter_of
from canopy_skel.kernels.compiled import inner, kernel
from canopy_skel.kernels.heap import is_before, pop_row, push_row
from canopy_skel.kernels.median import median_of

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


@inner("void(float64[:,::1], int64, int64, float64, int64[:,::1])")
def cells_of(points: Floats, first: int, end: int, cell_m: float, cells: Ints) -> None:
    """Write the cells (3,) of points [first, end), from their lowest corner on."""
    for j in range(3):
        low = math.inf
        for n in range(first, end):
            low = min(low, points[n, j])
        for n in range(first, end):
            cells[n - first, j] = math.floor((points[n, j] - low) / cell_m)


@inner("int64(int64[:,::1], int64, int64[:,::1])")
def sorted_cells(cells: Ints, count: int, ascending: Ints) -> int:
    """Write each of `count` cells once, in ascending order; return how many there are.

    Not a grid of the box around them: what is long and slanting has few cells in a vast box.
    """
    heap = np.zeros((count + 2, 3), dtype=np.int64)
    for n in range(count):
        x, y, z = cells[n, 0], cells[n, 1], cells[n, 2]
        # Most pixels lie in the cell of the one before.
        if n == 0 or cells[n - 1, 0] != x or cells[n - 1, 1] != y or cells[n - 1, 2] != z:
            push_row(heap, x, y, z)
    different = 0
    while heap[0, 0] > 0:
        x, y, z = heap[1, 0], heap[1, 1], heap[1, 2]
        if different == 0 or is_before(ascending, different - 1, x, y, z):
            ascending[different, 0], ascending[different, 1], ascending[different, 2] = x, y, z
            different += 1
        pop_row(heap)
    return different


@inner("int64(int64[:,::1], int64, int64, int64, int64)")
def place_of(ascending: Ints, count: int, x: int, y: int, z: int) -> int:
    """Return the first place of `count` ascending cells that is not before (x, y, z)."""
    low, high = 0, count
    while low < high:
        middle = (low + high) // 2
        if is_before(ascending, middle, x, y, z):
            low = middle + 1
        else:
            high = middle
    return low


@inner("void(int64[:,::1], int64, int64, int64, int64[::1], int64[::1])")
def flood(ascending: Ints, count: int, cell: int, number: int, numbers: Ints, stack: Ints) -> None:
    """Give a cell (-1) and all that touch it, by a corner at least, their number."""
    numbers[cell], stack[0], waiting = number, cell, 1
    while waiting > 0:
        waiting -= 1
        here = stack[waiting]
        x, y, z = ascending[here, 0], ascending[here, 1], ascending[here, 2]
        for a in range(x - 1, x + 2):
            for b in range(y - 1, y + 2):
                other = place_of(ascending, count, a, b, z - 1)
                while other < count and is_before(ascending, other, a, b, z + 2):
                    if numbers[other] == -1:
                        numbers[other], stack[waiting] = number, other
                        waiting += 1
                    other += 1


@kernel("Tuple((int64[::1], int64[::1]))(float64[:,::1], int64[::1], float64)")
def parts_of(points: Floats, start: Ints, cell_m: float) -> tuple[Ints, Ints]:
    """Split groups of points (N, 3) into parts that touch in cells of this size.

    Returns the part of each point and the group of each part; a group's parts are numbered by
    their first cell.
    """
    part, group = np.empty(len(points), dtype=np.int64), np.empty(len(points), dtype=np.int64)
    parts = 0
    for i in range(len(start) - 1):
        first, count = start[i], start[i + 1] - start[i]
        cells = np.empty((count, 3), dtype=np.int64)
        ascending = np.empty((count, 3), dtype=np.int64)
        cells_of(points, first, start[i + 1], cell_m, cells)
        different = sorted_cells(cells, count, ascending)
        numbers, stack = np.empty(different, dtype=np.int64), np.empty(different, dtype=np.int64)
        for cell in range(different):
            numbers[cell] = -1
        for cell in range(different):
            if numbers[cell] == -1:
                group[parts] = i
                flood(ascending, different, cell, parts, numbers, stack)
                parts += 1
        for n in range(count):
            cell = place_of(ascending, different, cells[n, 0], cells[n, 1], cells[n, 2])
            part[first + n] = numbers[cell]
    return part, group[:parts].copy()


@kernel("float64[:,::1](float64[:,::1], int64[::1])")
def shapes_of(points: Floats, start: Ints) -> Floats:
    """Return per group (G, 2): second over first principal deviation, and the median of z.

    The former is 0 for a line, 1 for a blob or a dot.
    """
    shapes = np.empty((len(start) - 1, 2))
    mean, spread, vectors = np.empty(3), np.empty((3, 3)), np.empty((3, 3))
    for i in range(len(start) - 1):
        first, end = start[i], start[i + 1]
        scatter_of(points, first, end, mean, spread)
        diagonalise(spread, vectors)
        a, b, c = spread[0, 0], spread[1, 1], spread[2, 2]
        largest = max(a, max(b, c))
        second = max(min(a, b), min(max(a, b), c))
        blob = math.sqrt(max(largest, 0.0) / (end - first)) <= 1e-9
        shapes[i, 0] = 1.0 if blob else math.sqrt(max(second, 0.0) / largest)
        z = np.empty(end - first)
        for n in range(first, end):
            z[n - first] = points[n, 2]
        shapes[i, 1] = median_of(z)
    return shapes
