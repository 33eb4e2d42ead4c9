"""Algorithm 1 of the paper, exact, by one multi-source search that is repaired after each join.

A distance is one int64: cost in units of 2^-36 nat above LENGTH_BITS bits of path length (5, 7 or 9
per step, near enough to 1 : sqrt 2 : sqrt 3). The fine unit keeps a saturated map (p near 1) from
being a plateau: paths still follow its ridges. Ties are broken by length, then by the lower
predecessor, so nothing wanders.
"""

import heapq
import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from canopy_skel.kernels.blocks import find

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Int32s = NDArray[np.int32]

UNITS_PER_NAT = 1 << 36
LENGTH_BITS = 15
STEP_LENGTH = (0, 5, 7, 9)
UNREACHED = 1 << 62


@njit(cache=True, nogil=True)
def edge_weight(q_u: float, q_v: float, step: int) -> int:
    """Return -log((p_u + p_v) / 2) (paper eq. 4) with its length, from q = 1 - p."""
    cost: int = round(-math.log1p(-0.5 * (q_u + q_v)) * UNITS_PER_NAT)
    return (cost << LENGTH_BITS) + STEP_LENGTH[step]


@njit(cache=True, nogil=True)
def root_of(parent: Int32s, label: int) -> int:
    """Return the representative of a component, shortening the way to it."""
    while parent[label] != label:
        parent[label] = parent[parent[label]]
        label = parent[label]
    return label


@njit(cache=True, nogil=True)
def neighbours_of(voxels: Int32s, top: Int32s, origin: Ints, slots: Int32s, node: int) -> Ints:
    """Return (n, 2): the 26-neighbours of a node and how many coordinates differ (1, 2 or 3)."""
    found = np.zeros((26, 2), dtype=np.int64)
    count = 0
    x, y, z = voxels[node]
    for dx in range(-1, 2):
        for dy in range(-1, 2):
            for dz in range(-1, 2):
                step = abs(dx) + abs(dy) + abs(dz)
                if step == 0:
                    continue
                other = find(top, origin, slots, x + dx, y + dy, z + dz)
                if other >= 0:
                    found[count] = (other, step)
                    count += 1
    return found[:count]


@njit(cache=True, nogil=True)
def settle(
    heap: list[tuple[int, int]],
    voxels: Int32s,
    q: Floats,
    top: Int32s,
    origin: Ints,
    slots: Int32s,
    distance: Ints,
    previous: Int32s,
    label: Int32s,
) -> Ints:
    """Relax from the (distance, node) heap until it is empty; return the nodes that changed.

    A node follows the neighbour with the least (distance through it, number); a node whose
    predecessor got another label takes it over, so that labels stay those of the forest.
    """
    changed = [0]
    changed.clear()
    while heap:
        reached, u = heapq.heappop(heap)
        if reached != distance[u]:
            continue
        changed.append(u)
        for v, step in neighbours_of(voxels, top, origin, slots, u):
            through = reached + edge_weight(q[u], q[v], step)
            if through > distance[v]:
                continue
            if through == distance[v]:
                relabel = previous[v] == u and label[v] != label[u]
                if not (u < previous[v] or relabel):
                    continue
            distance[v] = through
            previous[v] = u
            label[v] = label[u]
            heapq.heappush(heap, (through, v))
    return np.unique(np.array(changed))


@njit(cache=True, nogil=True)
def borders(
    nodes: Ints,
    voxels: Int32s,
    q: Floats,
    top: Int32s,
    origin: Ints,
    slots: Int32s,
    distance: Ints,
    label: Int32s,
    parent: Int32s,
) -> list[tuple[int, int, int]]:
    """Return (path length, u, v), u < v, of all edges from these nodes between two components."""
    edges = [(0, 0, 0)]
    edges.clear()
    for u in nodes:
        if distance[u] == UNREACHED:
            continue
        for v, step in neighbours_of(voxels, top, origin, slots, u):
            if distance[v] == UNREACHED:
                continue
            if root_of(parent, label[u]) != root_of(parent, label[v]):
                total = distance[u] + edge_weight(q[u], q[v], step) + distance[v]
                edges.append((total, min(u, v), max(u, v)))
    return edges


@njit(cache=True, nogil=True)
def trace(previous: Int32s, u: int, v: int) -> Ints:
    """Return the path over edge (u, v), from the source behind u to the source behind v."""
    path = [u]
    while previous[path[-1]] != path[-1]:
        path.append(int(previous[path[-1]]))
    path.reverse()
    path.append(v)
    while previous[path[-1]] != path[-1]:
        path.append(int(previous[path[-1]]))
    return np.array(path)


@njit(cache=True, nogil=True)
def join_components(
    voxels: Int32s,
    q: Floats,
    top: Int32s,
    origin: Ints,
    slots: Int32s,
    sources: Int32s,
    source_label: Int32s,
    label_count: int,
) -> tuple[Ints, Ints, Ints]:
    """Join components by the cheapest path between any two of them, again and again (Algorithm 1).

    `voxels` (N, 3) are the nodes in lexicographic order and `q` (N,) their 1 - p; `top`, `origin`
    and `slots` index them. `sources` (S,) are the nodes that contain skeleton, `source_label` (S,)
    the component of each.

    Returns the nodes of all paths, one after the other, each from source to source; the first
    index of each path; the cost of each path in 2^-36 nat.
    """
    distance = np.full(len(voxels), UNREACHED)
    previous = np.full(len(voxels), -1, dtype=np.int32)
    label = np.full(len(voxels), -1, dtype=np.int32)
    parent = np.arange(label_count).astype(np.int32)
    heap = [(0, 0)]
    heap.clear()
    for i in range(len(sources)):
        s = sources[i]
        distance[s], previous[s], label[s] = 0, s, source_label[i]
        heap.append((0, int(s)))
    settle(heap, voxels, q, top, origin, slots, distance, previous, label)
    everywhere = np.arange(len(voxels))
    edges = borders(everywhere, voxels, q, top, origin, slots, distance, label, parent)
    heapq.heapify(edges)
    path_nodes = [0]
    path_nodes.clear()
    path_starts = [0]
    path_starts.clear()
    costs = [0]
    costs.clear()
    while edges:
        total, u, v = heapq.heappop(edges)
        if root_of(parent, label[u]) == root_of(parent, label[v]):
            continue
        step = np.abs(voxels[u] - voxels[v]).sum()
        if total != distance[u] + edge_weight(q[u], q[v], step) + distance[v]:
            continue
        path = trace(previous, u, v)
        kept, gone = root_of(parent, label[u]), root_of(parent, label[v])
        parent[max(kept, gone)] = min(kept, gone)
        path_starts.append(len(path_nodes))
        costs.append(total >> LENGTH_BITS)
        for node in path:
            path_nodes.append(node)
            if distance[node] > 0:
                distance[node], previous[node] = 0, node
                label[node] = min(kept, gone)
                heap.append((0, node))
        heapq.heapify(heap)
        changed = settle(heap, voxels, q, top, origin, slots, distance, previous, label)
        for edge in borders(changed, voxels, q, top, origin, slots, distance, label, parent):
            heapq.heappush(edges, edge)
    return np.array(path_nodes), np.array(path_starts), np.array(costs)
