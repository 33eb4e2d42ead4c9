"""From maps of direction and radius to strands: linked cells, cut where they bend, grown out.

Cells are those of the network's output grid; lengths and radii here are in cells.
"""

import numpy as np
from numba import njit
from numpy.typing import NDArray

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
I32 = NDArray[np.int32]
I64 = NDArray[np.int64]
Bool = NDArray[np.bool_]


@njit(cache=True, nogil=True)
def smoothed(inside: Bool, maps: F32, out: F32) -> None:
    """Fill out (K, h, w) with the mean of the maps over those of 3 x 3 cells that are inside."""
    count, height, width = maps.shape
    for i in range(height):
        for j in range(width):
            if not inside[i, j]:
                continue
            near = 0
            for k in range(count):
                out[k, i, j] = 0.0
            for a in range(max(i - 1, 0), min(i + 2, height)):
                for b in range(max(j - 1, 0), min(j + 2, width)):
                    if inside[a, b]:
                        near += 1
                        for k in range(count):
                            out[k, i, j] += maps[k, a, b]
            for k in range(count):
                out[k, i, j] /= near


@njit(cache=True)
def _root(parent: I32, i: int) -> int:
    while parent[i] != i:
        parent[i] = parent[parent[i]]
        i = parent[i]
    return i


@njit(cache=True, nogil=True)
def linked(inside: Bool, maps: F32, least_cosine: float, most_ratio: float, out: I32) -> int:
    """Number the regions of inside cells linked to neighbours of like direction and radius.

    maps: (3, h, w) cosine and sine of twice the angle, log radius. least_cosine: of twice the
    angle between neighbours. most_ratio: of radii, logarithmic. out: (h, w), 0 = none, else 1, 2 …
    """
    height, width = inside.shape
    parent = np.arange(height * width).astype(np.int32)
    for i in range(height):
        for j in range(width):
            if not inside[i, j]:
                continue
            c, s = maps[0, i, j], maps[1, i, j]
            norm = np.sqrt(c * c + s * s) + 1e-9
            for a, b in ((i, j - 1), (i - 1, j - 1), (i - 1, j), (i - 1, j + 1)):
                if a < 0 or b < 0 or b >= width or not inside[a, b]:
                    continue
                x, y = maps[0, a, b], maps[1, a, b]
                if c * x + s * y < least_cosine * norm * (np.sqrt(x * x + y * y) + 1e-9):
                    continue
                if abs(maps[2, i, j] - maps[2, a, b]) > most_ratio:
                    continue
                p, q = _root(parent, i * width + j), _root(parent, a * width + b)
                parent[max(p, q)] = min(p, q)
    count = 0
    for i in range(height):
        for j in range(width):
            out[i, j] = 0
            if inside[i, j]:
                here = i * width + j
                top = _root(parent, here)
                if top == here:
                    count += 1
                    out[i, j] = count
                else:
                    out[i, j] = out[top // width, top % width]
    return count


@njit(cache=True)
def _axis(rows: I32, columns: I32) -> tuple[float, float, float, float]:
    """Return the centroid (u, v) and the unit principal axis of cells."""
    n = len(rows)
    u, v = 0.0, 0.0
    for k in range(n):
        u += columns[k]
        v += rows[k]
    u, v = u / n, v / n
    uu, uv, vv = 0.0, 0.0, 0.0
    for k in range(n):
        a, b = columns[k] - u, rows[k] - v
        uu += a * a
        uv += a * b
        vv += b * b
    angle = 0.5 * np.arctan2(2 * uv, uu - vv)
    return u, v, np.cos(angle), np.sin(angle)


@njit(cache=True)
def _cut(rows: I32, columns: I32, radius: float, rule: F64, along: F64) -> float:
    """Return where along its axis a strand bends, inf if nowhere; fill `along` (N,).

    rule: least offset, share of the length, share of the radius, least length to look at.
    """
    u, v, c, s = _axis(rows, columns)
    low, high = np.inf, -np.inf
    for k in range(len(rows)):
        along[k] = c * (columns[k] - u) + s * (rows[k] - v)
        low, high = min(low, along[k]), max(high, along[k])
    length = high - low + 1.0
    if length < rule[3]:
        return np.inf
    bins = int(min(max(length / 4.0, 3.0), 16.0))
    weight, offset = np.zeros(bins), np.zeros(bins)
    for k in range(len(rows)):
        place = min(int((along[k] - low) / length * bins), bins - 1)
        weight[place] += 1.0
        offset[place] += c * (rows[k] - v) - s * (columns[k] - u)
    first, last = offset[0] / max(weight[0], 1.0), offset[bins - 1] / max(weight[bins - 1], 1.0)
    worst, where = max(rule[0], rule[1] * length, rule[2] * radius), np.inf
    for place in range(1, bins - 1):
        if weight[place] > 0:
            chord = first + (last - first) * place / (bins - 1)
            away = abs(offset[place] / weight[place] - chord)
            if away > worst:
                worst, where = away, low + (place + 0.5) / bins * length
    return where


@njit(cache=True, nogil=True)
def straightened(label: I32, count: int, log_radius: F32, least_cells: int, rule: F64) -> int:
    """Cut the regions of `label` where they bend, in place; return how many there are now.

    Regions of fewer than `least_cells` become 0. rule: see `_cut`.
    """
    height, width = label.shape
    sizes = np.zeros(count + 2, dtype=np.int64)
    for i in range(height):
        for j in range(width):
            sizes[label[i, j] + 1] += 1
    starts = np.cumsum(sizes)
    rows = np.empty(height * width - starts[1], dtype=np.int32)
    columns = np.empty_like(rows)
    fill = starts - starts[1]
    for i in range(height):
        for j in range(width):
            k = label[i, j]
            if k > 0:
                rows[fill[k]], columns[fill[k]] = i, j
                fill[k] += 1
                label[i, j] = 0
    along = np.empty(len(rows))
    stack = [(np.int64(0), np.int64(0))]
    stack.pop()
    found = 0
    for k in range(1, count + 1):
        stack.append((starts[k] - starts[1], starts[k + 1] - starts[1]))
        while len(stack) > 0:
            begin, end = stack.pop()
            if end - begin < least_cells:
                continue
            mean = 0.0
            for n in range(begin, end):
                mean += log_radius[rows[n], columns[n]]
            radius = np.exp(mean / (end - begin))
            own = along[begin:end]
            where = _cut(rows[begin:end], columns[begin:end], radius, rule, own)
            if where == np.inf:
                found += 1
                for n in range(begin, end):
                    label[rows[n], columns[n]] = found
                continue
            middle = begin
            for n in range(begin, end):
                if along[n] < where:
                    rows[n], rows[middle] = rows[middle], rows[n]
                    columns[n], columns[middle] = columns[middle], columns[n]
                    along[n], along[middle] = along[middle], along[n]
                    middle += 1
            if middle == begin or middle == end:
                continue
            stack.append((begin, middle))
            stack.append((middle, end))
    return found


@njit(cache=True, nogil=True)
def grown(label: I32, inside: Bool, log_radius: F32, reach: float) -> None:
    """Let regions grow over inside cells, nearest first, up to `reach` radii from where they were.

    label: (h, w), changed in place. The radius is that of the cell grown from.
    """
    height, width = label.shape
    queue = np.empty((label.size, 4), dtype=np.int32)
    end = 0
    for i in range(height):
        for j in range(width):
            if label[i, j] > 0:
                queue[end, 0], queue[end, 1], queue[end, 2], queue[end, 3] = i, j, i, j
                end += 1
    begin = 0
    while begin < end:
        i, j = np.int64(queue[begin, 0]), np.int64(queue[begin, 1])
        y, x = np.int64(queue[begin, 2]), np.int64(queue[begin, 3])
        begin += 1
        far = (reach * np.exp(log_radius[y, x]) + 1.0) ** 2
        for a, b in ((i - 1, j), (i, j - 1), (i, j + 1), (i + 1, j)):
            if a < 0 or b < 0 or a >= height or b >= width:
                continue
            if label[a, b] > 0 or not inside[a, b] or (a - y) ** 2 + (b - x) ** 2 > far:
                continue
            label[a, b] = label[i, j]
            queue[end, 0], queue[end, 1], queue[end, 2], queue[end, 3] = a, b, y, x
            end += 1
