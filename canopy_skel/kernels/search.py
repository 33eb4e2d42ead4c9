"""Shortest paths from many sources at once over the 26-neighbours of a voxel grid.

The paper's edge cost -log((p_u + p_v) / 2) is taken from levels (p in 1/255) in 1/4096 nat, plus 5,
7 or 9 for the length of the step (near enough to 1 : sqrt 2 : sqrt 3): without it p = 1 would make
plateaus in which a path wanders. Costs are integers, so repairs are exact. Of equally good ways a
voxel takes the one through the lowest direction, which is the lowest voxel: what comes out is a
function of levels and sources alone. No step costs less than WIDTH, so all entries of a bucket of
this width are final once it is their turn.
"""

import numpy as np
from numpy.typing import NDArray

from canopy_skel.kernels.compiled import inner, kernel
from canopy_skel.kernels.grid import CENTRE
from canopy_skel.kernels.steps import COSTS, LENGTHS, UNREACHED, beside

Bytes = NDArray[np.uint8]
Ints = NDArray[np.int64]
Int32s = NDArray[np.int32]

WIDTH = 5
WINDOW = 8192
"""Buckets of a round; the dearest step spans fewer than WINDOW of them."""
MASK = 2 * WINDOW - 1


@inner("int32[::1](int32[::1], int64)")
def resized(entries: Int32s, length: int) -> Int32s:
    """Return a copy with room for `length` entries, or of the first ones."""
    copy = np.empty(length, dtype=np.int32)
    for i in range(min(len(entries), length)):
        copy[i] = entries[i]
    return copy


@inner("boolean(int64, uint8[::1], int32[:,::1], int32[::1], uint8[::1], int32[::1])")
def pull(
    v: int, levels: Bytes, neighbours: Int32s, distance: Int32s, previous: Bytes, label: Int32s
) -> bool:
    """Give v the best way through its neighbours if it is better than its own; say if it is."""
    best, through, found = int(distance[v]), int(previous[v]), 0
    if distance[v] == UNREACHED:
        through = 27
    for k in range(27):
        u = beside(neighbours, v, k)
        if k == CENTRE or levels[u] == 0 or distance[u] == UNREACHED:
            continue
        cost = int(distance[u]) + COSTS[int(levels[u]) + int(levels[v])] + LENGTHS[k]
        if cost < best or (cost == best and k < through):
            best, through, found = cost, k, u
    if found == 0:
        return False
    distance[v], previous[v], label[v] = best, through, label[found]
    return True


@inner("int32[::1](int32[::1], int32[:,::1], int32[::1], uint8[::1], uint8[::1])")
def invalidate(
    seeds: Int32s, neighbours: Int32s, distance: Int32s, previous: Bytes, touched: Bytes
) -> Int32s:
    """Make unreached all whose way leads through the seeds; return them, seeds first.

    A seed itself is made unreached unless it is a source (previous = CENTRE). Blocks whose borders
    may change are noted in `touched`.
    """
    stack = resized(seeds, max(1024, len(seeds)))
    count = len(seeds)
    for i in range(count):
        if previous[stack[i]] != CENTRE:
            distance[stack[i]] = UNREACHED
    done = 0
    while done < count:
        u = int(stack[done])
        done += 1
        touched[u >> 9] = 1
        for k in range(27):
            v = beside(neighbours, u, k)
            if k < CENTRE:
                touched[v >> 9] = 1
            if previous[v] == 26 - k and k != CENTRE and distance[v] != UNREACHED:
                distance[v] = UNREACHED
                if count == len(stack):
                    stack = resized(stack, 2 * count)
                stack[count] = v
                count += 1
    return resized(stack, count)


@inner("int64(int32[::1], int32[::1], uint8[::1], int32[::1], int32[:,::1], int64[::1])")
def fill_ring(
    waiting: Int32s, distance: Int32s, queued: Bytes, heads: Int32s, pool: Int32s, state: Ints
) -> int:
    """Put the nearest waiting slots into the buckets; return how many go on waiting.

    state: entries in the pool, entries in the buckets, first bucket, bucket the round ends at.
    """
    nearest = int(UNREACHED)
    for i in range(len(waiting)):
        if queued[waiting[i]]:
            nearest = min(nearest, distance[waiting[i]] // WIDTH)
    state[0], state[1], state[2], state[3] = 0, 0, nearest, nearest + WINDOW
    kept = 0
    for i in range(len(waiting)):
        slot = waiting[i]
        bucket = distance[slot] // WIDTH
        if not queued[slot]:
            continue
        if bucket >= state[3]:
            waiting[kept] = slot
            kept += 1
        else:
            pool[state[0], 0], pool[state[0], 1] = slot, heads[bucket & MASK]
            heads[bucket & MASK] = state[0]
            state[0] += 1
    state[1] = state[0]
    return kept


@inner("int32[::1](int32[::1], int64, int32[::1], int32[:,::1], int64)")
def empty_ring(waiting: Int32s, kept: int, heads: Int32s, pool: Int32s, count: int) -> Int32s:
    """Return the slots that wait, those still in the buckets among them."""
    waiting = resized(waiting, kept + count)
    for bucket in range(len(heads)):
        entry = heads[bucket]
        heads[bucket] = -1
        while entry >= 0:
            waiting[kept] = pool[entry, 0]
            kept += 1
            entry = pool[entry, 1]
    return waiting


@inner("int32[:,::1](int32[:,::1], int64)")
def larger(pool: Int32s, length: int) -> Int32s:
    """Return a copy of a pool (N, 2) with room for `length` entries."""
    copy = np.empty((length, 2), dtype=np.int32)
    for i in range(min(len(pool), length)):
        copy[i, 0], copy[i, 1] = pool[i, 0], pool[i, 1]
    return copy


@inner(
    "void(int64, uint8[::1], int32[:,::1], int32[::1], uint8[::1], int32[::1], uint8[::1],"
    " uint8[::1], int32[::1], int32[:,::1], int64[::1])"
)
def relax(
    u: int,
    levels: Bytes,
    neighbours: Int32s,
    distance: Int32s,
    previous: Bytes,
    label: Int32s,
    queued: Bytes,
    touched: Bytes,
    heads: Int32s,
    pool: Int32s,
    state: Ints,
) -> None:
    """Offer all neighbours of u the way through u."""
    reached, level, own = int(distance[u]), int(levels[u]), label[u]
    touched[u >> 9] = 1
    for k in range(27):
        v = beside(neighbours, u, k)
        if k < CENTRE:
            touched[v >> 9] = 1
        if levels[v] == 0 or k == CENTRE:
            continue
        through = reached + COSTS[level + int(levels[v])] + LENGTHS[k]
        known = int(distance[v])
        if through > known or through >= UNREACHED:
            continue
        if through == known:
            if 26 - k > previous[v]:
                continue
            previous[v] = 26 - k
            if label[v] == own:
                continue
        distance[v], previous[v], label[v] = through, 26 - k, own
        bucket = through // WIDTH
        if queued[v] and known // WIDTH == bucket:
            continue
        queued[v] = 1
        pool[state[0], 0], pool[state[0], 1] = v, heads[bucket & MASK]
        heads[bucket & MASK] = state[0]
        state[0] += 1
        state[1] += 1


@inner(
    "int64(int32[::1], uint8[::1], int32[:,::1], int32[::1], uint8[::1], int32[::1], uint8[::1],"
    " uint8[::1])"
)
def settle(
    waiting: Int32s,
    levels: Bytes,
    neighbours: Int32s,
    distance: Int32s,
    previous: Bytes,
    label: Int32s,
    queued: Bytes,
    touched: Bytes,
) -> int:
    """Relax from the waiting slots (all `queued`) until nothing changes; return how many settled.

    Buckets are lists of (slot, next) in a pool, in a ring. What is too far off for the ring waits
    for a later round. A slot may have several entries; only the first finds it queued.
    """
    heads = np.empty(MASK + 1, dtype=np.int32)
    for i in range(len(heads)):
        heads[i] = -1
    pool = np.empty((max(1 << 16, 2 * len(waiting)), 2), dtype=np.int32)
    state = np.zeros(4, dtype=np.int64)
    settled = 0
    while len(waiting) > 0:
        kept = fill_ring(waiting, distance, queued, heads, pool, state)
        current = state[2]
        while state[1] > 0 and (current < state[3] or kept == 0):
            entry = heads[current & MASK]
            if entry < 0:
                current += 1
                continue
            heads[current & MASK] = pool[entry, 1]
            state[1] -= 1
            u = int(pool[entry, 0])
            if queued[u]:
                queued[u] = 0
                settled += 1
                if state[0] + 27 > len(pool):
                    pool = larger(pool, 2 * len(pool))
                relax(
                    u, levels, neighbours, distance, previous, label, queued, touched, heads,
                    pool, state,
                )  # fmt: skip
        waiting = empty_ring(waiting, kept, heads, pool, state[1])
        if len(waiting) > len(pool):
            pool = larger(pool, 2 * len(waiting))
    return settled


@kernel(
    "int64(int32[::1], int32[::1], int32[::1], int32[::1], int32[::1], uint8[::1], int32[:,::1],"
    " int32[::1], uint8[::1], int32[::1], uint8[::1], uint8[::1])"
)
def repair(
    raised: Int32s,
    lowered: Int32s,
    gone: Int32s,
    sources: Int32s,
    source_label: Int32s,
    levels: Bytes,
    neighbours: Int32s,
    distance: Int32s,
    previous: Bytes,
    label: Int32s,
    queued: Bytes,
    touched: Bytes,
) -> int:
    """Make the forest of shortest ways right again; return how many slots were settled.

    `raised` and `lowered` are the slots whose level has changed, `gone` those that are no longer
    sources, `sources` those that are new or have another label. Ways that got dearer are cut off
    and found anew; all else can only have become better.
    """
    seeds = np.empty(len(gone) + len(lowered), dtype=np.int32)
    for i in range(len(gone)):
        previous[gone[i]] = 27  # no way at all
        seeds[i] = gone[i]
    for i in range(len(lowered)):
        seeds[len(gone) + i] = lowered[i]
    cut = invalidate(seeds, neighbours, distance, previous, touched)
    waiting = np.empty(len(cut) + len(raised) + len(sources), dtype=np.int32)
    count = 0
    for i in range(len(sources)):
        s = int(sources[i])
        distance[s], previous[s], label[s] = 0, CENTRE, source_label[i]
        queued[s] = 1
        waiting[count] = s
        count += 1
    for i in range(len(cut) + len(raised)):
        v = int(cut[i] if i < len(cut) else raised[i - len(cut)])
        if levels[v] == 0:
            continue
        better = pull(v, levels, neighbours, distance, previous, label)
        if (better or (i >= len(cut) and distance[v] != UNREACHED)) and queued[v] == 0:
            queued[v] = 1
            waiting[count] = v
            count += 1
    return settle(
        resized(waiting, count), levels, neighbours, distance, previous, label, queued, touched
    )
