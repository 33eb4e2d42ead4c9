"""One numbering for one skeleton, whatever order its vertices came in."""

import numpy as np

from canopy_skel.geometry import IntArray
from canopy_skel.graph import SkeletonGraph


def canonical_order(graph: SkeletonGraph) -> IntArray:
    """Return (V,) vertex indices in an order that depends only on what the skeleton is.

    Vertices are sorted by position, radius, confidence and flag. Vertices alike in all of these
    are told apart by their neighbours (colour refinement; on a forest it separates all vertices
    but those that a symmetry of the graph maps on each other, and between these the choice
    cannot show).
    """
    keys = np.column_stack(
        [graph.vertices_in_base, graph.radius_m, graph.confidence, graph.occluded]
        + ([] if graph.source is None else [graph.source])
    )
    order = np.lexsort(keys.T[::-1])
    changed = np.any(keys[order[1:]] != keys[order[:-1]], axis=1)
    rank = _ranks(order, changed)
    if not changed.all():
        rank = _refined(rank, graph.edges)
    return np.argsort(rank, kind="stable").astype(np.int64)


def renumbered(graph: SkeletonGraph, old_of_new: IntArray) -> SkeletonGraph:
    """Return the graph with vertex `old_of_new[i]` as vertex i, edges as sorted (low, high)."""
    new_of_old = np.empty_like(old_of_new)
    new_of_old[old_of_new] = np.arange(len(old_of_new))
    edges = np.sort(new_of_old[graph.edges], axis=1).reshape(-1, 2)
    return SkeletonGraph(
        vertices_in_base=graph.vertices_in_base[old_of_new],
        edges=edges[np.lexsort((edges[:, 0], edges[:, 1]))],
        radius_m=graph.radius_m[old_of_new],
        occluded=graph.occluded[old_of_new],
        confidence=graph.confidence[old_of_new],
        source=None if graph.source is None else graph.source[old_of_new],
    )


def _ranks(order: IntArray, changed: np.ndarray) -> IntArray:
    """Give each vertex the place in `order` of the first vertex that equals it."""
    first = np.concatenate([[0], np.where(changed, np.arange(1, len(order)), 0)])
    rank = np.empty_like(order)
    rank[order] = np.maximum.accumulate(first)
    return rank


def _refined(rank: IntArray, edges: IntArray) -> IntArray:
    """Split equal ranks by the ranks of the neighbours until nothing splits any more."""
    ranks: list[int] = rank.tolist()
    neighbours: list[list[int]] = [[] for _ in ranks]
    for a, b in edges.tolist():
        neighbours[a].append(b)
        neighbours[b].append(a)
    tied = _tied(ranks)
    while tied:
        split: dict[int, int] = {}
        for group in tied:
            key = {v: sorted(ranks[w] for w in neighbours[v]) for v in group}
            ordered = sorted(group, key=key.__getitem__)
            place = base = ranks[group[0]]
            for offset, v in enumerate(ordered):
                if offset and key[v] != key[ordered[offset - 1]]:
                    place = base + offset
                split[v] = place
        if all(ranks[v] == place for v, place in split.items()):
            break
        for v, place in split.items():
            ranks[v] = place
        tied = _tied(ranks)
    return np.array(ranks, dtype=np.int64)


def _tied(ranks: list[int]) -> list[list[int]]:
    groups: dict[int, list[int]] = {}
    for v, rank in enumerate(ranks):
        groups.setdefault(rank, []).append(v)
    return [group for group in groups.values() if len(group) > 1]
