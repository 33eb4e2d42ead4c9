"""Which gaps between seen parts of the truth an output closes."""

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array, csr_array
from scipy.sparse.csgraph import connected_components, dijkstra, minimum_spanning_tree
from scipy.spatial import cKDTree

from canopy_skel.geometry import BoolArray, FloatArray, IntArray
from canopy_skel.metrics.pieces import simple_edges, subdivide

_ZERO_M = 1e-12


@dataclass(frozen=True, kw_only=True, slots=True)
class Gap:
    """An unseen path of the truth between two seen parts: the vertices at its lips, its length."""

    lips: tuple[int, int]
    length_m: float


def length_graph(positions: FloatArray, edges: IntArray) -> csr_array:
    """Return the (V, V) sparse matrix of edge lengths in metres, upper triangle only."""
    edges = simple_edges(edges)
    length_m = np.linalg.norm(positions[edges[:, 0]] - positions[edges[:, 1]], axis=1)
    shape = (len(positions), len(positions))
    weights = np.maximum(length_m, _ZERO_M)  # a stored zero would read as no edge
    return coo_array((weights, (edges[:, 0], edges[:, 1])), shape=shape).tocsr()


def find_gaps(positions: FloatArray, edges: IntArray, seen: BoolArray) -> list[Gap]:
    """Find the gaps between the seen parts of a tree.

    A maximal connected set of unseen vertices is one hole; the seen vertices next to it are its
    lips. A hole with n lips makes n - 1 gaps: the pairs of the minimum spanning tree of its lips
    over the path length through the hole.

    Args:
        positions: (V, 3) metres.
        edges: (E, 2), acyclic.
        seen: (V,).
    """
    unseen_edges = edges[~seen[edges].any(axis=1)]
    ones = np.ones(len(unseen_edges), dtype=np.int8)
    shape = (len(positions), len(positions))
    hole_of = connected_components(
        coo_array((ones, (unseen_edges[:, 0], unseen_edges[:, 1])), shape=shape), directed=False
    )[1]
    rim = edges[seen[edges].sum(axis=1) == 1]
    lip = np.where(seen[rim[:, 0]], rim[:, 0], rim[:, 1])
    hole_of_lip = hole_of[np.where(seen[rim[:, 0]], rim[:, 1], rim[:, 0])]
    gaps: list[Gap] = []
    for hole in np.unique(hole_of_lip):
        lips = np.unique(lip[hole_of_lip == hole])
        if len(lips) > 1:
            inside = ~seen & (hole_of == hole)
            around = edges[inside[edges].any(axis=1)]
            gaps += _spanning_gaps(positions, around, lips)
    return gaps


def _spanning_gaps(positions: FloatArray, edges: IntArray, lips: IntArray) -> list[Gap]:
    members, local = np.unique(edges, return_inverse=True)
    graph = length_graph(positions[members], local.reshape(-1, 2))
    at = np.searchsorted(members, lips)
    between_m = dijkstra(graph, directed=False, indices=at)[:, at]
    tree = minimum_spanning_tree(np.triu(np.maximum(between_m, _ZERO_M), 1)).tocoo()
    return [
        Gap(lips=(int(lips[i]), int(lips[j])), length_m=float(length_m))
        for i, j, length_m in zip(tree.row, tree.col, tree.data, strict=True)
    ]


def joined_gaps(
    gaps: list[Gap],
    truth_positions: FloatArray,
    positions: FloatArray,
    edges: IntArray,
    *,
    tolerance_m: float,
    spacing_m: float,
) -> list[bool]:
    """Say of each gap whether the output connects its lips.

    It does when a path of at most 1.5 x the gap's length + 60 mm runs in the output from a point
    within `tolerance_m` of one lip to a point within `tolerance_m` of the other. Output edges are
    subdivided to `spacing_m` first, so that only the curve counts and not where its vertices lie.
    A point near both lips counts for the nearer: else two stumps that face each other would do.
    """
    if not gaps or len(positions) == 0:
        return [False] * len(gaps)
    positions, edges = subdivide(positions, edges, spacing_m)
    graph = length_graph(positions, edges)
    tree = cKDTree(positions)
    joined = []
    for gap in gaps:
        a, b = truth_positions[list(gap.lips)]
        near_a, near_b = _near(tree, positions, a, b, tolerance_m)
        limit_m = 1.5 * gap.length_m + 0.06
        if len(near_a) and len(near_b):
            path_m = dijkstra(graph, directed=False, indices=near_a, min_only=True, limit=limit_m)
            joined.append(bool((path_m[near_b] <= limit_m).any()))
        else:
            joined.append(False)
    return joined


def _near(
    tree: cKDTree, positions: FloatArray, a: FloatArray, b: FloatArray, tolerance_m: float
) -> tuple[IntArray, IntArray]:
    near = np.unique(np.concatenate(tree.query_ball_point([a, b], tolerance_m))).astype(np.int64)
    to_a_m = np.linalg.norm(positions[near] - a, axis=1)
    to_b_m = np.linalg.norm(positions[near] - b, axis=1)
    by_a = (to_a_m <= tolerance_m) & (to_a_m < to_b_m)
    by_b = (to_b_m <= tolerance_m) & (to_b_m < to_a_m)
    return near[by_a], near[by_b]
