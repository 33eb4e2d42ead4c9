"""Algorithm 1, literally, on a small map: every pair of subgraphs, every round, from scratch."""

import heapq
import math
from itertools import combinations, product

STEP_LENGTH = (0, 5, 7, 9)
UNITS_PER_NAT = 1 << 24
OFFSETS = [o for o in product((-1, 0, 1), repeat=3) if any(o)]


def weight(q, u, v):
    """(cost in 2^-24 nat, length): compared in this order, as the fast search does."""
    cost = round(-math.log1p(-0.5 * (q[u] + q[v])) * UNITS_PER_NAT)
    return cost, STEP_LENGTH[sum(abs(a - b) for a, b in zip(u, v, strict=True))]


def neighbours(q, u):
    for offset in OFFSETS:
        v = tuple(a + b for a, b in zip(u, offset, strict=True))
        if v in q:
            yield v


def cheapest(q, sources, targets):
    """Dijkstra between two sets of voxels; None if there is no way."""
    best = dict.fromkeys(sources, (0, 0))
    heap = [((0, 0), u) for u in sources]
    heapq.heapify(heap)
    while heap:
        reached, u = heapq.heappop(heap)
        if reached > best[u]:
            continue
        if u in targets:
            return reached
        for v in neighbours(q, u):
            w = weight(q, u, v)
            through = (reached[0] + w[0], reached[1] + w[1])
            if v not in best or through < best[v]:
                best[v] = through
                heapq.heappush(heap, (through, v))
    return None


def forest(q, components):
    """Shortest way to the nearest component; of equal ones through the lower voxel."""
    order = {v: i for i, v in enumerate(sorted(q))}
    best = {v: (0, 0) for component in components for v in component}
    previous = {v: v for v in best}
    label = {v: i for i, component in enumerate(components) for v in component}
    heap = [((0, 0), order[v], v) for v in best]
    heapq.heapify(heap)
    done = set()
    while heap:
        reached, _, u = heapq.heappop(heap)
        if u in done:
            continue
        done.add(u)
        label[u] = label[previous[u]]
        for v in neighbours(q, u):
            w = weight(q, u, v)
            through = (reached[0] + w[0], reached[1] + w[1])
            if v in done or previous.get(v) == v:
                continue
            if v not in best or (through, order[u]) < (best[v], order[previous[v]]):
                best[v], previous[v] = through, u
                heapq.heappush(heap, (through, order[v], v))
    return best, previous, label


def trace(previous, v):
    path = [v]
    while previous[path[-1]] != path[-1]:
        path.append(previous[path[-1]])
    return path


def join_costs(q, components):
    """The cost of every round's cheapest path between any two subgraphs (the paper's words)."""
    components, costs = [set(c) for c in components], []
    while True:
        ways = [
            (cost, i, j)
            for i, j in combinations(range(len(components)), 2)
            if (cost := cheapest(q, components[i], components[j])) is not None
        ]
        if not ways:
            return costs
        cost, _, _ = min(ways)
        path = best_path(q, components)
        costs.append(cost)
        components = merge(components, path)


def join_paths(q, components):
    """The paths of all rounds under the canonical tie order, each round from scratch."""
    components, paths = [set(c) for c in components], []
    while (path := best_path(q, components)) is not None:
        paths.append(path)
        components = merge(components, path)
    return paths


def best_path(q, components):
    order = {v: i for i, v in enumerate(sorted(q))}
    best, previous, label = forest(q, components)
    edges = []
    for u in best:
        for v in neighbours(q, u):
            if v in best and order[u] < order[v] and label[u] != label[v]:
                w = weight(q, u, v)
                total = tuple(map(sum, zip(best[u], w, best[v], strict=True)))
                edges.append((total, order[u], order[v], u, v))
    if not edges:
        return None
    _, _, _, u, v = min(edges)
    return trace(previous, u)[::-1] + trace(previous, v)


def merge(components, path):
    ends = [i for i, c in enumerate(components) if path[0] in c or path[-1] in c]
    joined = set(path).union(*(components[i] for i in ends))
    return [c for i, c in enumerate(components) if i not in ends] + [joined]
