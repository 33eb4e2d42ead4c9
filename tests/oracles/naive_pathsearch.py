"""Algorithm 1, literally, on a small map: every pair of subgraphs, every round, from scratch."""

import heapq
import math
from itertools import combinations, product

STEP_LENGTH = (0, 5, 7, 9)
UNITS_PER_NAT = 4096
OFFSETS = [o for o in product((-1, 0, 1), repeat=3) if any(o)]


def level(units):
    """255 p, rounded, at least 1; units are -log(1 - p) in 1/65536 nat, taken in steps of 64."""
    return max(1, round(255 * (1 - math.exp(-((units >> 6) + 0.5) / 1024))))


def weight(levels, u, v):
    """-log((p_u + p_v) / 2) in 1/4096 nat, plus what stands for the length of the step."""
    cost = round(-math.log((levels[u] + levels[v]) / 510) * UNITS_PER_NAT)
    return cost + STEP_LENGTH[sum(abs(a - b) for a, b in zip(u, v, strict=True))]


def neighbours(levels, u):
    for offset in OFFSETS:
        v = tuple(a + b for a, b in zip(u, offset, strict=True))
        if v in levels:
            yield v


def cheapest(levels, sources, targets):
    """Dijkstra between two sets of voxels; None if there is no way."""
    best = dict.fromkeys(sources, 0)
    heap = [(0, u) for u in sources]
    heapq.heapify(heap)
    while heap:
        reached, u = heapq.heappop(heap)
        if reached > best[u]:
            continue
        if u in targets:
            return reached
        for v in neighbours(levels, u):
            through = reached + weight(levels, u, v)
            if v not in best or through < best[v]:
                best[v] = through
                heapq.heappush(heap, (through, v))
    return None


def forest(levels, components):
    """Shortest way to the nearest component; of equal ones through the lower voxel."""
    order = {v: i for i, v in enumerate(sorted(levels))}
    best = {v: 0 for component in components for v in component}
    previous = {v: v for v in best}
    label = {v: i for i, component in enumerate(components) for v in component}
    heap = [(0, order[v], v) for v in best]
    heapq.heapify(heap)
    done = set()
    while heap:
        reached, _, u = heapq.heappop(heap)
        if u in done:
            continue
        done.add(u)
        label[u] = label[previous[u]]
        for v in neighbours(levels, u):
            through = reached + weight(levels, u, v)
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


def join_costs(levels, components):
    """The cost of every round's cheapest path between any two subgraphs (the paper's words)."""
    components, costs = [set(c) for c in components], []
    while True:
        ways = [
            (cost, i, j)
            for i, j in combinations(range(len(components)), 2)
            if (cost := cheapest(levels, components[i], components[j])) is not None
        ]
        if not ways:
            return costs
        cost, _, _ = min(ways)
        path = best_path(levels, components)
        costs.append(cost)
        components = merge(components, path)


def join_paths(levels, components):
    """The paths of all rounds under the canonical tie order, each round from scratch."""
    components, paths = [set(c) for c in components], []
    while (path := best_path(levels, components)) is not None:
        paths.append(path)
        components = merge(components, path)
    return paths


def best_path(levels, components):
    order = {v: i for i, v in enumerate(sorted(levels))}
    best, previous, label = forest(levels, components)
    edges = []
    for u in best:
        for v in neighbours(levels, u):
            if v in best and order[u] < order[v] and label[u] != label[v]:
                total = best[u] + weight(levels, u, v) + best[v]
                edges.append((total, order[u], order[v], u, v))
    if not edges:
        return None
    _, _, _, u, v = min(edges)
    return trace(previous, u)[::-1] + trace(previous, v)


def merge(components, path):
    ends = [i for i, c in enumerate(components) if path[0] in c or path[-1] in c]
    joined = set(path).union(*(components[i] for i in ends))
    return [c for i, c in enumerate(components) if i not in ends] + [joined]
