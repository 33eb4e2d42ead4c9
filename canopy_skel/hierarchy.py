"""From an undirected skeleton to a rooted tree of branches: what planners need.

The paper ends with an acyclic graph. Here it gets a root, parents by the path to it, and
branches that run on through forks where direction, radius and the wood behind agree best.
"""

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import breadth_first_order

from canopy_skel.canonical import canonical_order, renumbered
from canopy_skel.geometry import IntArray
from canopy_skel.graph import SkeletonGraph
from canopy_skel.roots import fragment_root, main_root

# Directions are measured over this much wood: longer than the jags of a voxel path, shorter
# than the distance between two forks of a canopy branch.
REACH_M = 0.06


@dataclass(frozen=True, kw_only=True, eq=False, slots=True)
class BranchPath:
    """One branch: vertices from the parent's vertex it leaves at outward to its tip.

    parent: index of the parent in `Hierarchy.branches`, None for the first branch of a component.
    order: 0 for the trunk, else one more than the parent's; a component that is not joined to
    the main tree starts at 1, because whatever it hangs on is not seen.
    """

    parent: int | None
    order: int
    vertices: tuple[int, ...]


@dataclass(frozen=True, kw_only=True, eq=False, slots=True)
class Hierarchy:
    """A skeleton rooted and cut into branches.

    graph: the skeleton, its vertices numbered by a depth-first walk that starts at the root of
    the main tree (vertex 0), follows each branch to its tip and then takes side branches from
    the tip back; components follow one another, the main tree first, then by size.
    parent: (V,) the next vertex toward the root, always a smaller number; -1 at a root.
    branches: in the order of the walk, parents before children; they partition the edges.
    """

    graph: SkeletonGraph
    parent: IntArray
    branches: tuple[BranchPath, ...]


def build_hierarchy(graph: SkeletonGraph) -> Hierarchy:
    """Root a skeleton and cut it into branches; the result does not depend on vertex order.

    Raises:
        ValueError: the graph has a cycle (a loop or a doubled edge counts as one).
    """
    components, _ = graph.components()
    if len(graph.edges) != len(graph.vertices_in_base) - components:
        raise ValueError(
            f"a skeleton of {len(graph.vertices_in_base)} vertices in {components} components has"
            f" {len(graph.edges)} edges, so it has a cycle; hand in a forest"
        )
    if components == 0:
        return Hierarchy(graph=graph, parent=np.empty(0, dtype=np.int64), branches=())
    graph = renumbered(graph, canonical_order(graph))
    roots = _roots(graph)
    rooted = _Rooted(graph, roots)
    continuation = rooted.continuations()
    old_of_new, paths = _walk(roots, rooted, continuation)
    new_of_old = np.empty_like(old_of_new)
    new_of_old[old_of_new] = np.arange(len(old_of_new))
    parent = rooted.parent[old_of_new]
    return Hierarchy(
        graph=renumbered(graph, old_of_new),
        parent=np.where(parent < 0, -1, new_of_old[parent]),
        branches=tuple(
            BranchPath(
                parent=path.parent,
                order=path.order,
                vertices=tuple(new_of_old[list(path.vertices)].tolist()),
            )
            for path in paths
        ),
    )


def _roots(graph: SkeletonGraph) -> list[int]:
    """Return one root per component, the main tree's first, the others by falling size."""
    root = main_root(graph)
    main = _Rooted(graph, [root])
    continuation = main.continuations()
    trunk = [root]
    while continuation[trunk[-1]] >= 0:
        trunk.append(continuation[trunk[-1]])
    count, label = graph.components()
    members = np.split(np.argsort(label, kind="stable"), np.cumsum(np.bincount(label))[:-1])
    trunk_points = graph.vertices_in_base[trunk]
    fragments = [members[i] for i in range(count) if i != label[root]]
    fragments.sort(key=len, reverse=True)
    return [root, *(fragment_root(graph, fragment, trunk_points) for fragment in fragments)]


class _Rooted:
    """A forest hung up at its roots; vertices of components without a root stay out of it."""

    def __init__(self, graph: SkeletonGraph, roots: list[int]) -> None:
        """Find every vertex's parent, children and the length of wood behind it."""
        n = len(graph.vertices_in_base)
        ends = np.concatenate([graph.edges, [(n, root) for root in roots]])
        adjacency = coo_array((np.ones(len(ends), dtype=np.int8), ends.T), shape=(n + 1, n + 1))
        order, predecessor = breadth_first_order(adjacency.tocsr(), n, directed=False)
        parent = predecessor[:n].astype(np.int64)
        self.parent: IntArray = np.where((parent < 0) | (parent == n), -1, parent)
        self.outward: list[int] = order[1:].tolist()
        self._points = graph.vertices_in_base
        self._radius = graph.radius_m
        self._children: list[list[int]] = [[] for _ in range(n)]
        for v in sorted(self.outward):
            if self.parent[v] >= 0:
                self._children[self.parent[v]].append(v)
        self._wood_m = self._wood_behind()
        self._heaviest = [
            max(children, key=lambda c: self._wood_m[c], default=-1) for children in self._children
        ]

    def children(self, vertex: int) -> list[int]:
        """Return the vertices that hang on this one, by number."""
        return self._children[vertex]

    def continuations(self) -> list[int]:
        """Return for each vertex the child its branch runs on to; -1 at a tip.

        At a fork each child scores cos(angle between the branch so far and the child's wood)
        + min(1, its radius / the branch's radius) + its share of the wood behind the fork: a
        straight thick stub does not end a trunk, nor does a long side limb.
        """
        continuation = [-1] * len(self._children)
        start = np.arange(len(self._children)).tolist()
        for v in self.outward:
            children = self._children[v]
            if not children:
                continue
            best = children[0] if len(children) == 1 else self._best_child(v, start[v])
            continuation[v] = best
            for child in children:
                start[child] = start[v] if child == best else v
        return continuation

    def _wood_behind(self) -> list[float]:
        """Return for each vertex the length of its subtree with the edge to its parent."""
        step = self._points - self._points[self.parent]
        step[self.parent < 0] = 0.0
        wood: list[float] = np.linalg.norm(step, axis=1).tolist()
        parent = self.parent.tolist()
        for v in reversed(self.outward):
            if parent[v] >= 0:
                wood[parent[v]] += wood[v]
        return wood

    def _best_child(self, fork: int, branch_start: int) -> int:
        children = self._children[fork]
        came = self._points[fork] - self._points[self._back(fork, branch_start)]
        total_m = sum(self._wood_m[c] for c in children) or 1.0
        fork_radius_m = float(self._radius[fork]) or 1.0

        def score(child: int) -> float:
            goes = self._points[self._along(fork, child)] - self._points[fork]
            norm = float(np.linalg.norm(came) * np.linalg.norm(goes))
            straight = float(came @ goes) / norm if norm > 0 else 0.0
            thick = min(1.0, float(self._radius[child]) / fork_radius_m)
            return straight + thick + self._wood_m[child] / total_m

        return max(children, key=score)

    def _back(self, fork: int, branch_start: int) -> int:
        """Return the vertex of the same branch about `REACH_M` toward the root."""
        v = fork
        while v != branch_start and self._distance_m(v, fork) < REACH_M:
            v = int(self.parent[v])
        return v

    def _along(self, fork: int, child: int) -> int:
        """Return the vertex about `REACH_M` outward through `child`, where most wood is."""
        v = child
        while self._heaviest[v] >= 0 and self._distance_m(v, fork) < REACH_M:
            v = self._heaviest[v]
        return v

    def _distance_m(self, a: int, b: int) -> float:
        return float(np.linalg.norm(self._points[a] - self._points[b]))


def _walk(
    roots: list[int], rooted: _Rooted, continuation: list[int]
) -> tuple[IntArray, list[BranchPath]]:
    """Return the vertices in depth-first order and the branches in the old numbering."""
    order: list[int] = []
    paths: list[BranchPath] = []
    for component, root in enumerate(roots):
        order.append(root)
        first_order = 0 if component == 0 else 1
        waiting: list[tuple[int | None, int, int, int]] = [
            (None, first_order, root, child) for child in rooted.children(root)
        ]
        while waiting:
            parent, branch_order, fork, child = waiting.pop()
            vertices = [fork]
            while child >= 0:
                vertices.append(child)
                waiting += [
                    (len(paths), branch_order + 1, child, side)
                    for side in rooted.children(child)
                    if side != continuation[child]
                ]
                child = continuation[child]
            order += vertices[1:]
            paths.append(BranchPath(parent=parent, order=branch_order, vertices=tuple(vertices)))
    return np.array(order, dtype=np.int64), paths
