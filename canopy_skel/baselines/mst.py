"""The paper's first baseline: the Euclidean minimum spanning tree joins everything (section IV)."""

import numpy as np
from scipy.sparse.csgraph import minimum_spanning_tree
from scipy.spatial import cKDTree

from canopy_skel.geometry import FloatArray, IntArray
from canopy_skel.graph import SkeletonGraph, add_bridges

UNKNOWN = 0.5
"""Confidence of what a baseline predicts: it has no measure of its own."""


def join_by_spanning_tree(graph: SkeletonGraph, spacing_m: float) -> SkeletonGraph:
    """Return the Euclidean minimum spanning tree of the initial vertices, gaps as straight lines.

    The initial skeleton is that tree without its long edges, so only the shortest way between its
    components is missing.
    """
    count, component = graph.components()
    if count < 2:
        return graph
    gap_m, nearest = _closest_pairs(graph.vertices_in_base, component, count)
    tree = minimum_spanning_tree(gap_m).tocoo()
    pairs = np.array(
        [(nearest[a, b], nearest[b, a]) for a, b in zip(tree.row, tree.col, strict=True)]
    )
    return add_bridges(graph, pairs, spacing_m, UNKNOWN)


def _closest_pairs(
    points: FloatArray, component: IntArray, count: int
) -> tuple[FloatArray, IntArray]:
    """Return gaps (C, C) in metres and nearest[a, b]: the vertex of a that is nearest to b."""
    gap_m, nearest = np.zeros((count, count)), np.zeros((count, count), dtype=np.int64)
    order = np.argsort(component, kind="stable")
    starts = np.searchsorted(component[order], np.arange(count))
    for b in range(count):
        distance = np.asarray(cKDTree(points[component == b]).query(points[order])[0])
        gap_m[:, b] = np.minimum.reduceat(distance, starts)
        for a, block in enumerate(np.split(np.arange(len(order)), starts[1:])):
            nearest[a, b] = order[block[np.argmin(distance[block])]]
    return np.maximum(gap_m, 1e-12), nearest
