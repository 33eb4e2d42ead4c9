"""Algorithm 1 of the paper on a forest of shortest ways: what is joined, in which order, how.

A border is an edge between voxels of different labels; the way over it costs the distances of its
two ends and itself. It is written as slot * 32 + direction, from the lower to the higher voxel.
"""

import numpy as np
from numpy.typing import NDArray

from canopy_skel.kernels.compiled import inner, kernel
from canopy_skel.kernels.grid import CENTRE, SLOTS
from canopy_skel.kernels.heap import pop, pop_row, push, push_row, with_room
from canopy_skel.kernels.steps import COSTS, LENGTHS, UNREACHED, beside, key_of
from canopy_skel.kernels.unions import root_of

Bytes = NDArray[np.uint8]
Ints = NDArray[np.int64]
Int32s = NDArray[np.int32]
Forest = tuple[Bytes, Int32s, Int32s, Int32s, Bytes, Int32s, Bytes]
"""By slot: level, then neighbours and places of blocks; distance, previous, label, marks."""
FOREST = (
    "Tuple((uint8[::1], int32[:,::1], int32[:,::1], int32[::1], uint8[::1], int32[::1],"
    " uint8[::1]))"
)


@inner("int64[::1](int64[::1], int64)")
def resized_long(entries: Ints, length: int) -> Ints:
    """Return a copy with room for `length` entries, or of the first ones."""
    copy = np.empty(length, dtype=np.int64)
    for i in range(min(len(entries), length)):
        copy[i] = entries[i]
    return copy


@inner("int64[::1](int64[::1], int64[::1])")
def joined(entries: Ints, more: Ints) -> Ints:
    """Return both, one after the other."""
    both = resized_long(entries, len(entries) + len(more))
    for i in range(len(more)):
        both[len(entries) + i] = more[i]
    return both


@kernel(
    "Tuple((int64[::1], int64[::1]))(int64[::1], uint8[::1], int32[:,::1], int32[::1], int32[::1])"
)
def borders_of(
    chosen: Ints,
    levels: Bytes,
    neighbours: Int32s,
    distance: Int32s,
    label: Int32s,
) -> tuple[Ints, Ints]:
    """Return the borders in the chosen blocks and their costs.

    Of each block the cheapest between any two labels, with those that cost the same.
    """
    edges, costs = np.empty(1 << 12, dtype=np.int64), np.empty(1 << 12, dtype=np.int64)
    room = SLOTS * CENTRE
    met, best = np.empty((room, 2), dtype=np.int64), np.empty(room, dtype=np.int64)
    edge, cost, of = np.empty(room, np.int64), np.empty(room, np.int64), np.empty(room, np.int64)
    total = 0
    for b in range(len(chosen)):
        found = pairs = 0
        for slot in range(chosen[b] << 9, (chosen[b] + 1) << 9):
            if levels[slot] == 0 or distance[slot] == UNREACHED:
                continue
            for k in range(CENTRE + 1, 27):
                v = beside(neighbours, slot, k)
                if levels[v] == 0 or label[v] == label[slot] or distance[v] == UNREACHED:
                    continue
                way = int(distance[slot]) + int(distance[v])
                way += COSTS[int(levels[slot]) + int(levels[v])] + LENGTHS[k]
                low, high = min(label[slot], label[v]), max(label[slot], label[v])
                pair = 0
                while pair < pairs and (met[pair, 0] != low or met[pair, 1] != high):
                    pair += 1
                if pair == pairs:
                    met[pair, 0], met[pair, 1], best[pair] = low, high, way
                    pairs += 1
                if way <= best[pair]:
                    best[pair] = way
                    edge[found], cost[found], of[found] = slot << 5 | k, way, pair
                    found += 1
        if total + found > len(edges):
            edges = resized_long(edges, 2 * (total + found))
            costs = resized_long(costs, 2 * (total + found))
        for i in range(found):
            if cost[i] == best[of[i]]:
                edges[total], costs[total] = edge[i], cost[i]
                total += 1
    return resized_long(edges, total), resized_long(costs, total)


@kernel("int64[:,::1](int64[::1], int32[:,::1], int32[:,::1], int32[::1])")
def ends_of(edges: Ints, neighbours: Int32s, places: Int32s, label: Int32s) -> Ints:
    """Return (N, 3): an ordering key of each border's lower voxel, and the labels of both ends."""
    ends = np.empty((len(edges), 3), dtype=np.int64)
    for i in range(len(edges)):
        slot = edges[i] >> 5
        ends[i, 0] = key_of(places, slot)
        ends[i, 1] = label[slot]
        ends[i, 2] = label[beside(neighbours, slot, edges[i] & 31)]
    return ends


@kernel("int64[::1](int64, int32[:,::1], uint8[::1])")
def trace(edge: int, neighbours: Int32s, previous: Bytes) -> Ints:
    """Return the slots of the way over a border, from source to source, the lower voxel's first."""
    path = np.empty(64, dtype=np.int64)
    u = edge >> 5
    v = beside(neighbours, u, edge & 31)
    path[0] = u
    count = 1
    while previous[u] != CENTRE:
        u = beside(neighbours, u, int(previous[u]))
        if count + 1 >= len(path):
            path = resized_long(path, 2 * len(path))
        path[count] = u
        count += 1
    for i in range(count // 2):
        path[i], path[count - 1 - i] = path[count - 1 - i], path[i]
    path[count] = v
    count += 1
    while previous[v] != CENTRE:
        v = beside(neighbours, v, int(previous[v]))
        if count == len(path):
            path = resized_long(path, 2 * len(path))
        path[count] = v
        count += 1
    return resized_long(path, count)


@inner("int64(int64, int64, int32[:,::1], int32[::1], uint8[::1], int32[::1], uint8[::1])")
def note(
    slot: int,
    count: int,
    journal: Int32s,
    distance: Int32s,
    previous: Bytes,
    label: Int32s,
    marks: Bytes,
) -> int:
    """Enter in the journal what is known of a slot before it changes first; new count."""
    if marks[slot] & 2:
        return count
    marks[slot] |= 2
    journal[count, 0], journal[count, 1] = slot, distance[slot]
    journal[count, 2], journal[count, 3] = previous[slot], label[slot]
    return count + 1


@inner("int32[:,::1](int32[:,::1], int64)")
def longer(journal: Int32s, length: int) -> Int32s:
    """Return a journal (N, 4) with room for `length` entries, a copy if it had none."""
    if length <= len(journal):
        return journal
    copy = np.empty((2 * length, 4), dtype=np.int32)
    for i in range(len(journal)):
        for j in range(4):
            copy[i, j] = journal[i, j]
    return copy


@inner("void(int32[:,::1], int64, int32[::1], uint8[::1], int32[::1], uint8[::1])")
def roll_back(
    journal: Int32s,
    count: int,
    distance: Int32s,
    previous: Bytes,
    label: Int32s,
    marks: Bytes,
) -> None:
    """Put everything back as the journal has it."""
    for i in range(count):
        slot = journal[i, 0]
        distance[slot], previous[slot] = journal[i, 1], journal[i, 2]
        label[slot], marks[slot] = journal[i, 3], 0


@inner(f"int64(int64, int64[::1], int64[:,::1], int32[:,::1], int64, int32[::1], {FOREST})")
def spread(
    u: int,
    pending: Ints,
    borders: Ints,
    journal: Int32s,
    noted: int,
    parent: Int32s,
    forest: Forest,
) -> int:
    """Offer all neighbours of a slot the way through it, and note the borders it is at.

    Heaps and journal must have room for 27 more. Returns the journal's new count.
    """
    levels, neighbours, places, distance, previous, label, marks = forest
    for k in range(27):
        v = beside(neighbours, u, k)
        if levels[v] == 0 or k == CENTRE:
            continue
        step = int(COSTS[int(levels[u]) + int(levels[v])] + LENGTHS[k])
        through, known = int(distance[u]) + step, int(distance[v])
        better = through < known or (through == known and 26 - k < previous[v])
        relabel = through == known and previous[v] == 26 - k
        if better or relabel:
            again = through < known or label[v] != label[u]
            if better or again:
                noted = note(v, noted, journal, distance, previous, label, marks)
                distance[v], previous[v], label[v] = through, 26 - k, label[u]
            if again:
                marks[v] |= 1
                push(pending, through << 32 | v)
        if distance[v] != UNREACHED and (
            root_of(parent, int(label[u])) != root_of(parent, int(label[v]))
        ):
            total = int(distance[u]) + step + int(distance[v])
            lower, way = (u, k) if k > CENTRE else (v, 26 - k)
            push_row(borders, total, key_of(places, lower), lower << 5 | way)
    return noted


@inner(f"UniTuple(int64, 2)(int64, int64, int32[::1], {FOREST})")
def joined_by(edge: int, total: int, parent: Int32s, forest: Forest) -> tuple[int, int]:
    """Return the two components that a border joins, twice the same if it costs this no more."""
    levels, neighbours, _, distance, _, label, _ = forest
    u, k = edge >> 5, edge & 31
    v = beside(neighbours, u, k)
    a, b = root_of(parent, int(label[u])), root_of(parent, int(label[v]))
    step = int(COSTS[int(levels[u]) + int(levels[v])] + LENGTHS[k])
    return (a, b) if total == int(distance[u]) + step + int(distance[v]) else (a, a)


@inner(f"int64(int64[::1], int64, int64[::1], int32[:,::1], int64, {FOREST})")
def make_wood(
    path: Ints, of: int, pending: Ints, journal: Int32s, noted: int, forest: Forest
) -> int:
    """Make a path wood of a component, from which ways start; return the journal's new count."""
    _, _, _, distance, previous, label, marks = forest
    for i in range(len(path)):
        w = path[i]
        if distance[w] > 0:
            noted = note(w, noted, journal, distance, previous, label, marks)
            distance[w], previous[w], label[w] = 0, CENTRE, of
            marks[w] |= 1
            push(pending, w)
    return noted


@inner("int64[:,::1](int64[::1], int64[::1], int64[:,::1])")
def heap_of(edges: Ints, costs: Ints, ends: Ints) -> Ints:
    """Return borders in canonical order as a heap, which they already are."""
    heap = np.empty((2 * len(edges) + 64, 3), dtype=np.int64)
    heap[0, 0] = len(edges)
    for i in range(len(edges)):
        heap[i + 1, 0], heap[i + 1, 1], heap[i + 1, 2] = costs[i], ends[i, 0], edges[i]
    return heap


@kernel(
    "Tuple((int64[::1], int64[::1], int64[::1], int64))"
    f"(int64[::1], int64[::1], int64[:,::1], int32[::1], int64, {FOREST})"
)
def join_all(
    edges: Ints, costs: Ints, ends: Ints, parent: Int32s, joins: int, forest: Forest
) -> tuple[Ints, Ints, Ints, int]:
    """Join components by the cheapest way between any two, `joins` times; each way then is wood.

    What a new way changes is worked out only as far as it can matter yet: no border of cost T has
    an end farther from wood than T / 2. All arrays are as before when this returns. Borders come in
    canonical order.

    Returns the slots of all ways one after the other, where each starts, what it costs, and how
    many slots were worked on.
    """
    _, neighbours, _, distance, previous, label, marks = forest
    borders, pending = heap_of(edges, costs, ends), np.zeros(1 << 12, dtype=np.int64)
    journal, noted, settled = np.empty((1 << 12, 4), dtype=np.int32), 0, 0
    slots, starts = np.empty(0, dtype=np.int64), np.empty(joins, dtype=np.int64)
    totals, done = np.empty(joins, dtype=np.int64), 0
    while done < joins and (borders[0, 0] or pending[0]):
        if pending[0] and (not borders[0, 0] or 2 * (pending[1] >> 32) <= borders[1, 0]):
            u = pending[1] & 0xFFFFFFFF
            pop(pending)
            if marks[u] & 1:
                marks[u] ^= 1
                settled += 1
                journal, borders = longer(journal, noted + 27), with_room(borders, 27)
                if pending[0] + 28 > len(pending):
                    pending = resized_long(pending, 2 * len(pending))
                noted = spread(u, pending, borders, journal, noted, parent, forest)
            continue
        total, edge = borders[1, 0], borders[1, 2]
        pop_row(borders)
        a, b = joined_by(edge, total, parent, forest)
        if a == b:
            continue
        path = trace(edge, neighbours, previous)
        parent[max(a, b)] = min(a, b)
        starts[done], totals[done] = len(slots), total
        slots, done = joined(slots, path), done + 1
        journal = longer(journal, noted + len(path))
        if pending[0] + len(path) >= len(pending):
            pending = resized_long(pending, 2 * (len(pending) + len(path)))
        noted = make_wood(path, min(a, b), pending, journal, noted, forest)
    roll_back(journal, noted, distance, previous, label, marks)
    return slots, resized_long(starts, done), resized_long(totals, done), settled
