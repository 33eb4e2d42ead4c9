"""Which gaps between seen parts of the truth an output closes."""

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array, csr_array
from scipy.sparse.csgraph import dijkstra, minimum_spanning_tree
from scipy.spatial import cKDTree

from canopy_skel.geometry import BoolArray, FloatArray, IntArray
from canopy_skel.metrics.matching import nearest
from canopy_skel.metrics.pieces import components_of, subdivide

_ZERO_M = 1e-12


@dataclass(frozen=True, kw_only=True, eq=False, slots=True)
class SeenTree:
    """The truth: positions (V, 3) metres, simple acyclic edges (E, 2), and which are seen (V,)."""

    positions: FloatArray
    edges: IntArray
    seen: BoolArray


@dataclass(frozen=True, kw_only=True, slots=True)
class Gap:
    """An unseen path of the truth between two seen parts: the vertices at its lips, its length."""

    lips: tuple[int, int]
    length_m: float


def length_graph(positions: FloatArray, edges: IntArray) -> csr_array:
    """Return the symmetric (V, V) sparse matrix of the lengths in metres of simple edges."""
    length_m = np.linalg.norm(positions[edges[:, 0]] - positions[edges[:, 1]], axis=1)
    shape = (len(positions), len(positions))
    weights = np.maximum(length_m, _ZERO_M)  # a stored zero would read as no edge
    both_ways = (np.append(edges[:, 0], edges[:, 1]), np.append(edges[:, 1], edges[:, 0]))
    return coo_array((np.tile(weights, 2), both_ways), shape=shape).tocsr()


def find_gaps(truth: SeenTree) -> list[Gap]:
    """Find the gaps between the seen parts of a tree.

    A maximal connected set of unseen vertices is one hole; the seen vertices next to it are its
    lips. A hole with n lips makes n - 1 gaps: the pairs of the minimum spanning tree of its lips
    over the path length through the hole.
    """
    edges, seen = truth.edges, truth.seen
    hole_of = components_of(len(seen), edges[~seen[edges].any(axis=1)])
    open_edges = edges[~seen[edges].all(axis=1)]
    hole = hole_of[np.where(seen[open_edges[:, 0]], open_edges[:, 1], open_edges[:, 0])]
    order = np.argsort(hole, kind="stable")
    gaps: list[Gap] = []
    for around in np.split(open_edges[order], np.flatnonzero(np.diff(hole[order])) + 1):
        lips = np.unique(around[seen[around]])
        if len(lips) > 1:
            gaps += _spanning_gaps(truth.positions, around, lips)
    return gaps


def _spanning_gaps(positions: FloatArray, edges: IntArray, lips: IntArray) -> list[Gap]:
    members, local = np.unique(edges, return_inverse=True)
    graph = length_graph(positions[members], local.reshape(-1, 2))
    at = np.searchsorted(members, lips)
    between_m = dijkstra(graph, indices=at)[:, at]
    tree = minimum_spanning_tree(np.triu(np.maximum(between_m, _ZERO_M), 1)).tocoo()
    return [
        Gap(lips=(int(lips[i]), int(lips[j])), length_m=float(length_m))
        for i, j, length_m in zip(tree.row, tree.col, tree.data, strict=True)
    ]


def joined_gaps(
    gaps: list[Gap],
    truth: SeenTree,
    positions: FloatArray,
    edges: IntArray,
    *,
    tolerance_m: float,
    spacing_m: float,
) -> list[bool]:
    """Say of each gap whether the output connects its lips.

    It does when a path of at most 1.5 x the gap's length + 60 mm runs in the output from one lip
    to the other. An output point stands at a lip when it is within `tolerance_m` of it and nearer
    to the seen part the lip belongs to than to any other: a branch that only passes close to both
    lips joins nothing. Edges of both are cut to `spacing_m` first, so that only curves count and
    not where their vertices lie.
    """
    if not gaps or len(positions) == 0:
        return [False] * len(gaps)
    points, pieces = subdivide(positions, edges, spacing_m)
    graph, tree = length_graph(points, pieces), cKDTree(points)
    part_at_lip, part_of_point = _parts(truth, points, tolerance_m, spacing_m)

    def points_at(lip: int) -> IntArray:
        near = np.asarray(tree.query_ball_point(truth.positions[lip], tolerance_m), dtype=np.int64)
        at_lip: IntArray = near[part_of_point[near] == part_at_lip[lip]]
        return at_lip

    joined = []
    for gap in gaps:
        start, goal = points_at(gap.lips[0]), points_at(gap.lips[1])
        reached = False
        if len(start) and len(goal):
            limit_m = 1.5 * gap.length_m + 0.06
            path_m = dijkstra(graph, indices=start, min_only=True, limit=limit_m)
            reached = bool((path_m[goal] <= limit_m).any())
        joined.append(reached)
    return joined


def _parts(
    truth: SeenTree, points: FloatArray, tolerance_m: float, spacing_m: float
) -> tuple[IntArray, IntArray]:
    """Number the seen parts: that of each vertex (V,), and the nearest of each point (P,) or -1."""
    seen_edges = truth.edges[truth.seen[truth.edges].all(axis=1)]
    fine, fine_edges = subdivide(truth.positions, seen_edges, spacing_m)
    part = components_of(len(fine), fine_edges)
    seen = np.flatnonzero(np.append(truth.seen, np.ones(len(fine) - len(truth.seen), np.bool_)))
    distance_m, index = nearest(points, fine[seen], tolerance_m)
    nearest_part = np.where(np.isfinite(distance_m), part[seen[index]], -1)
    return part[: len(truth.seen)], nearest_part
