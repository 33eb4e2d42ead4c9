"""Groups of points that touch, and the shape of each.

Points lie in groups one after the other: those of group i are start[i] up to start[i + 1].
"""

import math

import numpy as np
from numpy.typing import NDArray

from canopy_skel.kernels.axes import diagonalise, scatter_of
from canopy_skel.kernels.compiled import inner, kernel
from canopy_skel.kernels.median import median_of

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Int32s = NDArray[np.int32]


@inner("int64(float64[:,::1], int64, int64, float64, int64[:,::1])")
def cells_of(points: Floats, first: int, end: int, cell_m: float, cells: Ints) -> int:
    """Write the cells (3,) of points [first, end), from their lowest corner on.

    Row end - first takes how many cells there are along each axis; returns how many in all.
    """
    total = 1
    for j in range(3):
        low, most = math.inf, 0
        for n in range(first, end):
            low = min(low, points[n, j])
        for n in range(first, end):
            cell = math.floor((points[n, j] - low) / cell_m)
            cells[n - first, j] = cell
            most = max(most, cell + 1)
        cells[end - first, j] = most
        total *= most
    return total


@inner("void(int32[::1], int64[::1], int64, int64, int32[::1])")
def flood(grid: Int32s, shape: Ints, cell: int, number: int, stack: Int32s) -> None:
    """Give a cell (-1) and all that touch it, by a corner at least, their number."""
    grid[cell], stack[0], count = number, cell, 1
    while count > 0:
        count -= 1
        here = int(stack[count])
        x, y, z = here // (shape[1] * shape[2]), here // shape[2] % shape[1], here % shape[2]
        for a in range(max(x - 1, 0), min(x + 2, shape[0])):
            for b in range(max(y - 1, 0), min(y + 2, shape[1])):
                for c in range(max(z - 1, 0), min(z + 2, shape[2])):
                    other = (a * shape[1] + b) * shape[2] + c
                    if grid[other] == -1:
                        grid[other], stack[count] = number, other
                        count += 1


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
        if count == 0:
            continue
        cells = np.empty((count + 1, 3), dtype=np.int64)
        total, shape = cells_of(points, first, start[i + 1], cell_m, cells), cells[count]
        grid, stack = np.zeros(total, dtype=np.int32), np.empty(count, dtype=np.int32)
        for n in range(count):
            grid[(cells[n, 0] * shape[1] + cells[n, 1]) * shape[2] + cells[n, 2]] = -1
        before = parts
        for cell in range(total):
            if grid[cell] == -1:
                group[parts] = i
                parts += 1
                flood(grid, shape, cell, parts - before, stack)
        for n in range(count):
            cell = (cells[n, 0] * shape[1] + cells[n, 1]) * shape[2] + cells[n, 2]
            part[first + n] = before + grid[cell] - 1
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
