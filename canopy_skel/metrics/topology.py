"""Whether an output grows the way the truth does."""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from canopy_skel.document import SkeletonDocument
from canopy_skel.geometry import FloatArray, IntArray
from canopy_skel.metrics.matching import nearest, share
from canopy_skel.metrics.pieces import components_of, subdivide

STRIDE = 2.5


@dataclass(frozen=True, kw_only=True, eq=False, slots=True)
class Forest:
    """A rooted forest.

    positions: (V, 3) metres. parent: (V,), -1 at roots. depth_m: (V,) path length to the root.
    order: the vertices, parents first; those no root leads to are left out.
    """

    positions: FloatArray
    parent: IntArray
    depth_m: FloatArray
    order: IntArray

    def ancestors(self, distance_m: float) -> IntArray:
        """Return for each vertex (V,) its last ancestor, or itself, within `distance_m` of path."""
        found = np.arange(len(self.parent))
        while True:
            below = self.parent[found]
            go = (below >= 0) & (self.depth_m - self.depth_m[below] <= distance_m)
            if not go.any():
                return found
            found = np.where(go, below, found)

    def intervals(self) -> tuple[IntArray, IntArray]:
        """Number the vertices so that u leads to v (or is v) iff first[u] <= first[v] < end[u]."""
        size = np.ones(len(self.parent), dtype=np.int64)
        for vertex in self.order[::-1].tolist():
            if self.parent[vertex] >= 0:
                size[self.parent[vertex]] += size[vertex]
        first = np.full(len(self.parent), -1, dtype=np.int64)
        following, free = 0, np.zeros_like(size)
        for vertex in self.order.tolist():
            parent = self.parent[vertex]
            if parent < 0:
                first[vertex] = following
                following += size[vertex]
            else:
                first[vertex] = free[parent]
                free[parent] += size[vertex]
            free[vertex] = first[vertex] + 1
        return first, first + size


def forest_of(document: SkeletonDocument, spacing_m: float) -> Forest:
    """Root a document by its branches (each runs from base to tip), edges cut to `spacing_m`."""
    grown = [step for branch in document.branches for step in pairwise(branch.vertices)]
    table = np.array(grown, dtype=np.int64).reshape(-1, 2)
    positions, edges = subdivide(document.position, table, spacing_m)
    parent = np.full(len(positions), -1, dtype=np.int64)
    parent[edges[:, 1]] = edges[:, 0]
    children: list[list[int]] = [[] for _ in parent]
    for child in np.flatnonzero(parent >= 0).tolist():
        children[parent[child]].append(child)
    order = [int(root) for root in np.flatnonzero(parent < 0)]
    for vertex in order:
        order.extend(children[vertex])
    reached = np.zeros(len(parent), dtype=np.bool_)
    reached[order] = True
    parent = np.where(reached, parent, -1)
    to_parent_m = np.linalg.norm(positions - positions[parent], axis=1)
    depth_m = np.zeros(len(parent))
    for vertex in order:
        if parent[vertex] >= 0:
            depth_m[vertex] = depth_m[parent[vertex]] + to_parent_m[vertex]
    return Forest(
        positions=positions, parent=parent, depth_m=depth_m, order=np.array(order, dtype=np.int64)
    )


def parent_correct(
    document: SkeletonDocument, truth: SkeletonDocument, *, tolerance_m: float, spacing_m: float
) -> float | None:
    """Return the share, by length, of the output whose way to the root is a way down the truth.

    Each point of the output is compared with the first ancestor at least 2.5 x `tolerance_m` of
    path below it. Both must have truth within `tolerance_m`; an ancestor without is passed over
    for the next. The pair is right when the truth of the lower one, moved down by up to
    `tolerance_m`, leads to the truth of the upper one. None where there is no pair, or a document
    has no branches.
    """
    if not document.branches or not truth.branches:
        return None
    out, true = forest_of(document, spacing_m), forest_of(truth, spacing_m)
    distance_m, match = nearest(out.positions, true.positions, tolerance_m)
    matched = np.isfinite(distance_m)
    lower = out.parent[out.ancestors(STRIDE * tolerance_m * (1 - 1e-9))]
    carried = np.where(matched, np.arange(len(matched)), -1)
    for vertex in out.order.tolist():
        if carried[vertex] < 0 and out.parent[vertex] >= 0:
            carried[vertex] = carried[out.parent[vertex]]
    lower = np.where(lower >= 0, carried[lower], -1)
    pair = matched & (lower >= 0)
    first, end = true.intervals()
    below, above = true.ancestors(tolerance_m)[match[lower]], match
    right = (first[below] <= first[above]) & (first[above] < end[below])
    step_m = np.where(out.parent >= 0, out.depth_m - out.depth_m[out.parent], 0.0)
    return share(right, step_m, among=pair)


def components_and_acyclic(vertex_count: int, edges: IntArray) -> tuple[int, bool]:
    """Return the number of connected components of a graph and whether it is a forest.

    Loops and edges given twice are cycles.
    """
    if vertex_count == 0:
        return 0, True
    count = int(components_of(vertex_count, edges).max()) + 1
    return count, len(edges) == vertex_count - count
