"""From maps of middle line, direction and radius to strands: thinned, chained, cut, grown out.

Cells are those of the network's output grid; lengths and radii here are in cells, u to the right
and v down. A cell of a middle line links to at most one cell ahead and one behind, so that a fork
never makes one strand of two branches.
"""

import numpy as np
from numpy.typing import NDArray

from canopy_skel.kernels.compiled import inner, kernel

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
I32 = NDArray[np.int32]
I64 = NDArray[np.int64]
Bool = NDArray[np.bool_]

ACROSS = 0.35
"""How far aside a link may jump, in radii; the half width of a middle line's band."""


@kernel("void(boolean[:,::1], float32[:,:,::1], float32[:,:,::1])")
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


@inner("boolean(boolean[:,::1], int64, int64)")
def _joins_nothing(core: Bool, i: int, j: int) -> bool:
    """Say whether a cell is neither the end of a line nor what holds two parts together."""
    p2, p3, p4 = core[i - 1, j], core[i - 1, j + 1], core[i, j + 1]
    p5, p6, p7 = core[i + 1, j + 1], core[i + 1, j], core[i + 1, j - 1]
    p8, p9 = core[i, j - 1], core[i - 1, j - 1]
    parts = int(not p2 and (p3 or p4)) + int(not p4 and (p5 or p6))
    parts += int(not p6 and (p7 or p8)) + int(not p8 and (p9 or p2))
    if parts != 1:
        return False
    one = int(p9 or p2) + int(p3 or p4) + int(p5 or p6) + int(p7 or p8)
    two = int(p2 or p3) + int(p4 or p5) + int(p6 or p7) + int(p8 or p9)
    return min(one, two) >= 2


@inner("boolean(boolean[:,::1], int64, int64, boolean)")
def _removable(core: Bool, i: int, j: int, second: bool) -> bool:
    """Say whether a cell may go in this half of a round of Guo and Hall (1989)."""
    p2, p4, p6, p8 = core[i - 1, j], core[i, j + 1], core[i + 1, j], core[i, j - 1]
    if p2 and p4 and p6 and p8:  # most are: deep within
        return False
    p3, p5 = core[i - 1, j + 1], core[i + 1, j + 1]
    p7, p9 = core[i + 1, j - 1], core[i - 1, j - 1]
    one = int(p9 or p2) + int(p3 or p4) + int(p5 or p6) + int(p7 or p8)
    two = int(p2 or p3) + int(p4 or p5) + int(p6 or p7) + int(p8 or p9)
    if min(one, two) > 3 or not _joins_nothing(core, i, j):
        return False
    if second:
        return not ((p2 or p3 or not p5) and p4)
    return not ((p6 or p7 or not p9) and p8)


@inner("int64(boolean[:,::1], int32[:,::1], int64, int64, boolean[:,::1], int32[:,::1])")
def _beside(core: Bool, gone: I32, begin: int, end: int, listed: Bool, out: I32) -> int:
    """List the cells of the core beside gone[begin:end] once each; return how many.

    listed: (h, w), all False.
    """
    count = 0
    for k in range(begin, end):
        for i in range(gone[k, 0] - 1, gone[k, 0] + 2):
            for j in range(gone[k, 1] - 1, gone[k, 1] + 2):
                if core[i, j] and not listed[i, j]:
                    listed[i, j] = True
                    out[count, 0], out[count, 1] = i, j
                    count += 1
    for k in range(count):
        listed[out[k, 0], out[k, 1]] = False
    return count


@inner("void(boolean[:,::1], int32[:,::1])")
def _peeled(core: Bool, cells: I32) -> None:
    """Take off the core (h, w), which has these cells, all that Guo and Hall take off."""
    asked, gone = cells.copy(), np.empty(cells.shape, dtype=np.int32)
    listed = np.zeros(core.shape, dtype=np.bool_)
    half, count = 0, len(cells)
    before, begin, end = 0, 0, 0
    while half < 2 or count > 0:
        for k in range(count):
            i, j = asked[k]
            if core[i, j] and _removable(core, i, j, half % 2 == 1):
                gone[end, 0], gone[end, 1] = i, j
                end += 1
        for k in range(begin, end):
            core[gone[k, 0], gone[k, 1]] = False
        half += 1
        # What could not go in this kind of half may once something beside it has gone since.
        if half > 1:
            count = _beside(core, gone, before, end, listed, asked)
        before, begin = begin, end


@kernel("int32[:,::1](boolean[:,::1])")
def thinned(core: Bool) -> I32:
    """Thin a core (h, w) to lines one cell wide, in place; return (N, 2) row and column of them.

    Its outermost cells must be False. No line gets shorter than half its width.
    """
    height, width = core.shape
    cells = np.empty((core.size, 2), dtype=np.int32)
    count = 0
    for i in range(1, height - 1):
        for j in range(1, width - 1):
            if core[i, j]:
                cells[count, 0], cells[count, 1] = i, j
                count += 1
    _peeled(core, cells[:count])
    kept = 0
    for k in range(count):
        i, j = cells[k]
        if core[i, j] and _joins_nothing(core, i, j):
            core[i, j] = False
        if core[i, j]:
            cells[kept, 0], cells[kept, 1] = i, j
            kept += 1
    return cells[:kept].copy()


@inner("float64[:,::1](int32[:,::1], float32[:,:,::1])")
def _courses(cells: I32, maps: F32) -> F64:
    """Return what `_price` asks of cells, (N, 7).

    Cosine and sine of the angle and of twice it (as in the maps, not scaled), logarithm of the
    radius, the radius, how far aside a link may jump.
    """
    out = np.empty((len(cells), 7))
    for k in range(len(cells)):
        i, j = cells[k]
        x, y, log_radius = maps[0, i, j], maps[1, i, j], maps[2, i, j]
        angle = 0.5 * np.arctan2(y, x)
        radius = np.exp(log_radius)
        out[k, 0], out[k, 1], out[k, 2], out[k, 3] = np.cos(angle), np.sin(angle), x, y
        out[k, 4], out[k, 5], out[k, 6] = log_radius, radius, max(ACROSS * radius, 1.5)
    return out


@inner("float64(int32[:,::1], float64[:,::1], int64, int64, float64, float64[::1])")
def _price(cells: I32, courses: F64, a: int, b: int, window: float, gate: F64) -> float:
    """Return what it costs to go from cell a to b, inf if it is out of the question.

    The sign says whether b lies ahead of a. gate: least cosine of twice the angle between them,
    largest logarithmic ratio of their radii.
    """
    c, s = courses[a, 0], courses[a, 1]
    du, dv = cells[b, 1] - cells[a, 1], cells[b, 0] - cells[a, 0]
    along, across = c * du + s * dv, abs(c * dv - s * du)
    spread = 1.0 if abs(du) <= 1 and abs(dv) <= 1 else 0.5
    most = min(courses[a, 6], 0.3 + spread * abs(along))
    if abs(along) < 0.3 or abs(along) > window or across > most:
        return np.inf
    x, y, v, w = courses[a, 2], courses[a, 3], courses[b, 2], courses[b, 3]
    cosine = (x * v + y * w) / (np.sqrt((x * x + y * y) * (v * v + w * w)) + 1e-9)
    if cosine < gate[0] or abs(courses[b, 4] - courses[a, 4]) > gate[1]:
        return np.inf
    price = abs(along) + 2.0 * across + 4.0 * (1.0 - cosine)
    return float(price if along > 0 else -price)


@inner("int64(float64, int64)")
def _window(radius: float, tries: int) -> int:
    """Return how far to look for the next cell; farther with each try."""
    return int(min(max(1.0 + 1.5 * ACROSS * radius, 2.0) + tries, 9.0))


@kernel("int32[:,::1](int32[:,::1], int32[:,::1], float32[:,:,::1], float64[::1], int64)")
def links(number: I32, cells: I32, maps: F32, gate: F64, tries: int) -> I32:
    """Return (N, 2) the cell that each is linked with behind and ahead, -1 = none.

    number: (h, w) the place in `cells`, -1 = none; cells: (N, 2) row and column. gate: see
    `_price`. A link is made where it is the best for both of its cells among those still free on
    that side; then those left over try again.
    """
    height, width = number.shape
    link = np.full((len(cells), 2), -1, dtype=np.int32)
    best = np.empty((len(cells), 2), dtype=np.int32)
    courses, cost = _courses(cells, maps), np.empty(2)
    for attempt in range(tries):
        best[:] = -1
        for k in range(len(cells)):
            i, j = cells[k]
            if link[k, 0] >= 0 and link[k, 1] >= 0:
                continue
            window = _window(courses[k, 5], attempt)
            cost[:] = np.inf
            for a in range(max(i - window, 0), min(i + window + 1, height)):
                for b in range(max(j - window, 0), min(j + window + 1, width)):
                    n = number[a, b]
                    if n < 0 or n == k or n == link[k, 0] or n == link[k, 1]:
                        continue
                    ahead = courses[k, 0] * (b - j) + courses[k, 1] * (a - i)
                    side = 1 if ahead > 0 else 0
                    if link[k, side] >= 0:
                        continue
                    price = abs(_price(cells, courses, k, n, window, gate))
                    if price >= cost[side]:
                        continue
                    back = 1 if _price(cells, courses, n, k, 99.0, gate) > 0 else 0
                    if link[n, back] < 0:
                        cost[side], best[k, side] = price, n
        for k in range(len(cells)):
            for side in range(2):
                n = best[k, side]
                if n < 0:
                    continue
                for back in range(2):
                    if best[n, back] == k and link[n, back] < 0 and link[k, side] < 0:
                        link[k, side], link[n, back] = n, k
    return link


@kernel("Tuple((int32[::1], int64[::1]))(int32[:,::1])")
def chains(link: I32) -> tuple[I32, I64]:
    """Return the cells in the order of their chains, and where each chain starts and ends.

    A chain is a path; a ring is opened at its first cell.
    """
    count = len(link)
    order, starts = np.empty(count, dtype=np.int32), [np.int64(0)]
    seen = np.zeros(count, dtype=np.bool_)
    filled = 0
    for rings in (False, True):
        for first in range(count):
            degree = int(link[first, 0] >= 0) + int(link[first, 1] >= 0)
            if seen[first] or (degree == 2 and not rings):
                continue
            here = first
            while here >= 0:
                seen[here] = True
                order[filled] = here
                filled += 1
                a, b = link[here, 0], link[here, 1]
                if a >= 0 and not seen[a]:
                    here = a
                elif b >= 0 and not seen[b]:
                    here = b
                else:
                    here = -1
            starts.append(np.int64(filled))
    return order, np.array(starts)


@kernel("int64(int32[:,::1], float64, float64[::1])")
def bend(path: I32, radius: float, rule: F64) -> int:
    """Return which cell of a path lies farthest off its chord if that is a bend, else -1.

    rule: least offset, share of the length, share of the radius.
    """
    last = len(path) - 1
    if last < 4:
        return -1
    du, dv = path[last, 1] - path[0, 1], path[last, 0] - path[0, 0]
    length = np.sqrt(du * du + dv * dv) + 1e-9
    worst, where = max(rule[0], rule[1] * length, rule[2] * radius), -1
    for k in range(2, last - 1):
        away = abs((path[k, 1] - path[0, 1]) * dv - (path[k, 0] - path[0, 0]) * du) / length
        if away > worst:
            worst, where = away, k
    return where


@kernel("int64[:,::1](int32[:,::1], int64[::1], float32[:,::1], float64[::1], float64)")
def straight_pieces(cells: I32, starts: I64, log_radius: F32, rule: F64, least_cells: float) -> I64:
    """Cut chains where they bend; return (M, 2) begin and end of the pieces long enough.

    cells: (N, 2) in the order of their chains. rule: see `bend`.
    """
    pieces = [(np.int64(0), np.int64(0))]
    stack = [(np.int64(0), np.int64(0))]
    pieces.pop()
    stack.pop()
    for chain in range(len(starts) - 1):
        stack.append((starts[chain], starts[chain + 1]))
        while len(stack) > 0:
            begin, end = stack.pop()
            path = cells[begin:end]
            du, dv = path[-1, 1] - path[0, 1], path[-1, 0] - path[0, 0]
            if np.sqrt(du * du + dv * dv) < least_cells:
                continue
            mean = 0.0
            for k in range(len(path)):
                mean += log_radius[path[k, 0], path[k, 1]]
            cut = bend(path, np.exp(mean / len(path)), rule)
            if cut < 0:
                pieces.append((begin, end))
            else:
                stack.append((begin + cut, end))
                stack.append((begin, begin + cut))
    out = np.empty((len(pieces), 2), dtype=np.int64)
    for k in range(len(pieces)):
        out[k, 0], out[k, 1] = pieces[k]
    return out


@kernel("int64(int32[:,::1], int64[:,::1], float32[:,::1], int32[:,::1])")
def painted(cells: I32, pieces: I64, log_radius: F32, label: I32) -> int:
    """Number pieces in `label` (h, w) in the order given; return how many.

    A piece most of which runs beside an earlier one, closer than half a radius, is its double and
    is left out.
    """
    height, width = label.shape
    taken = np.zeros(label.shape, dtype=np.bool_)
    label[:] = 0
    found = 0
    for begin, end in pieces:
        double = 0
        for k in range(begin, end):
            double += taken[cells[k, 0], cells[k, 1]]
        if 2 * double > end - begin:
            continue
        found += 1
        for k in range(begin, end):
            i, j = cells[k]
            if not taken[i, j]:
                label[i, j] = found
        for k in range(begin, end):
            i, j = cells[k]
            near = max(0.5 * np.exp(log_radius[i, j]), 1.5)
            reach = int(near)
            for a in range(max(i - reach, 0), min(i + reach + 1, height)):
                for b in range(max(j - reach, 0), min(j + reach + 1, width)):
                    if (a - i) ** 2 + (b - j) ** 2 <= near * near:
                        taken[a, b] = True
    return found


@kernel("void(int32[:,::1], boolean[:,::1], float32[:,::1], float64)")
def grown(label: I32, inside: Bool, log_radius: F32, reach: float) -> None:
    """Let regions grow over inside cells, nearest first, up to `reach` radii from where they were.

    label: (h, w), changed in place. The radius is that of the cell grown from.
    """
    height, width = label.shape
    most = 0
    for i in range(height):
        for j in range(width):
            most += inside[i, j] or label[i, j] > 0
    queue = np.empty((most, 4), dtype=np.int64)
    end = 0
    for i in range(height):
        for j in range(width):
            if label[i, j] > 0:
                queue[end, 0], queue[end, 1], queue[end, 2], queue[end, 3] = i, j, i, j
                end += 1
    begin = 0
    while begin < end:
        i, j, y, x = queue[begin]
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
