"""Join what is disconnected by minimum cost paths through the map (paper III-D, Algorithm 1)."""

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from canopy_skel.geometry import FloatArray, IntArray
from canopy_skel.graph import SkeletonGraph
from canopy_skel.kernels import joins as kernels
from canopy_skel.kernels import search, steps, unions
from canopy_skel.likelihood import LikelihoodMap
from canopy_skel.voxels import Int32Array, VoxelIndex, distinct, grown, voxels_of

NO_WAY = 27


@dataclass(frozen=True, kw_only=True, eq=False, slots=True)
class Join:
    """One path of Algorithm 1, from wood to wood.

    cost_nat: -log of the mean p_l of each step's two voxels, summed (paper eq. 4), from the map
    itself. units: the rounded cost that decided. voxels: (n, 3).
    """

    cost_nat: float
    units: int
    voxels: Int32Array


class PathSearch:
    """Shortest ways from all wood through the map, kept right while both of them change.

    After every `update` all distances, ways and borders are those of a search from scratch, to the
    bit: costs are integers, and of equally good ways (cost, then the lowest voxel) decides. So
    nothing depends on the order in which views came.
    """

    def __init__(self, likelihood: LikelihoodMap) -> None:
        self._map = likelihood
        self.settled = 0
        """How many voxels the last update or `joins` had to work on."""
        self._levels = np.zeros(512, dtype=np.uint8)
        self._distance = np.full(512, steps.UNREACHED, dtype=np.int32)
        self._previous = np.full(512, NO_WAY, dtype=np.uint8)
        self._label = np.zeros(512, dtype=np.int32)
        self._marks = np.zeros(512, dtype=np.uint8)
        self._sources: IntArray = np.zeros(0, dtype=np.int64)
        self._labels: Int32Array = np.zeros(0, dtype=np.int32)
        self._label_count = 0
        self._component_of_label: Int32Array = np.zeros(0, dtype=np.int32)
        self._edges: IntArray = np.zeros(0, dtype=np.int64)
        self._costs: IntArray = np.zeros(0, dtype=np.int64)

    @property
    def nbytes(self) -> int:
        """Memory held, in bytes."""
        kept = (self._levels, self._distance, self._previous, self._label, self._marks)
        return sum(array.nbytes for array in kept)

    @property
    def distances(self) -> Int32Array:
        """Cost from the nearest wood per slot of the map, `steps.UNREACHED` where none leads."""
        return self._distance[: self._map.blocks.slots]

    def update(self, graph: SkeletonGraph) -> None:
        """Take over what has changed in the map, and this skeleton as the wood."""
        self._grow()
        raised, lowered = self._changed_levels()
        gone, fresh = self._replace_sources(graph)
        touched = np.zeros(self._map.blocks.count, dtype=np.uint8)
        order = np.searchsorted(self._sources, fresh)
        self.settled = search.repair(
            raised,
            lowered,
            gone,
            fresh.astype(np.int32),
            self._labels[order],
            self._levels,
            self._map.blocks.neighbours,
            self._distance,
            self._previous,
            self._label,
            self._marks,
            touched,
        )
        touched[0] = 0
        self._renew_borders(touched.astype(bool))

    def joins(self) -> list[Join]:
        """Run Algorithm 1: the cheapest path between any two subgraphs, until no more are found.

        Exact: after each join its path belongs to the subgraph, as in the paper. Ties are broken
        by (cost, voxel order), so the result does not depend on the order of anything.
        """
        edges, costs, ends, parent = self._cheapest()
        tree = unions.span(ends, parent.copy())
        slots, starts, totals, self.settled = kernels.join_all(
            edges,
            costs,
            ends,
            parent,
            len(tree),
            (
                self._levels,
                self._map.blocks.neighbours,
                self._map.blocks.places,
                self._distance,
                self._previous,
                self._label,
                self._marks,
            ),
        )
        return self._joins(slots, starts, totals)

    def preview(self) -> list[Join]:
        """Return the joins of a minimum spanning tree of the components: nearly Algorithm 1.

        Paths that were added do not serve as wood for later ones, so ways may run side by side.
        """
        edges, costs, ends, parent = self._cheapest()
        taken = unions.span(ends, parent)
        paths = [self._trace(int(edges[i])) for i in taken]
        starts = np.cumsum([0, *map(len, paths)])[:-1]
        slots = np.concatenate([np.zeros(0, dtype=np.int64), *paths])
        return self._joins(slots, starts, costs[taken])

    def _grow(self) -> None:
        slots = self._map.blocks.slots
        self._levels = grown(self._levels, slots, 0)
        self._distance = grown(self._distance, slots, steps.UNREACHED)
        self._previous = grown(self._previous, slots, NO_WAY)
        self._label = grown(self._label, slots, 0)
        self._marks = grown(self._marks, slots, 0)

    def _changed_levels(self) -> tuple[Int32Array, Int32Array]:
        """Take over the map's levels; return the slots where they rose and where they fell."""
        changed = self._map.take_changed()
        if self._label_count == 0:
            changed = np.flatnonzero(self._map.levels).astype(np.int32)
        old, new = self._levels[changed], self._map.levels[changed]
        self._levels[changed] = new
        return changed[new > old], changed[new < old]

    def _replace_sources(self, graph: SkeletonGraph) -> tuple[Int32Array, IntArray]:
        """Make the graph's voxels the sources; return those gone and those new or relabelled.

        Labels outlive components: where components only grow together, no voxel changes its label.
        """
        count, component = graph.components()
        slots = self._map.blocks.slots_of(voxels_of(graph.vertices_in_base, self._map.voxel_size_m))
        inside = np.flatnonzero(self._levels[slots])
        sources, first = np.unique(slots[inside], return_index=True)
        component = component[inside[first]]
        known = np.searchsorted(self._sources, sources)
        known[known == len(self._sources)] = 0
        old = np.full(len(sources), -1, dtype=np.int32)
        if len(self._sources):
            same = self._sources[known] == sources
            old[same] = self._labels[known[same]]
        labels = self._relabelled(old, component, count)
        still = np.searchsorted(sources, self._sources)
        still[still == len(sources)] = 0
        gone = self._sources[sources[still] != self._sources] if len(sources) else self._sources
        self._sources, self._labels = sources, labels
        return gone.astype(np.int32), sources[labels != old]

    def _relabelled(self, old: Int32Array, component: IntArray, count: int) -> Int32Array:
        """Give sources (S,) labels, old ones (-1 for none) as far as they tell components apart."""
        pair, times = np.unique(old * np.int64(count + 1) + component, return_counts=True)
        label, of = pair // (count + 1), pair % (count + 1)
        common = np.lexsort((of, -times))
        common = common[label[common] >= 0]
        # A label goes to the component most of its sources are in.
        owned, first = np.unique(label[common], return_index=True)
        owner = np.full(self._label_count + count, -1, dtype=np.int32)
        owner[owned] = of[common[first]]
        main = np.full(count, -1, dtype=np.int64)
        mine = common[owner[label[common]] == of[common]][::-1]
        main[of[mine]] = label[mine]
        without = np.flatnonzero(main < 0)
        main[without] = self._label_count + np.arange(len(without))
        owner[main] = np.arange(count)
        self._label_count += len(without)
        self._component_of_label = owner[: self._label_count]
        kept = (old >= 0) & (owner[old] == component)
        return np.where(kept, old, main[component]).astype(np.int32)

    def _renew_borders(self, touched: NDArray[np.bool_]) -> None:
        """Find the borders of the touched blocks anew, keeping those of all others."""
        chosen = np.flatnonzero(touched)
        edges, costs = kernels.borders_of(
            chosen,
            self._levels,
            self._map.blocks.neighbours,
            self._distance,
            self._label,
        )
        block = self._edges >> 14
        kept = ~touched[block]
        self._edges = np.concatenate([self._edges[kept], edges])
        self._costs = np.concatenate([self._costs[kept], costs])

    def _cheapest(self) -> tuple[IntArray, IntArray, IntArray, Int32Array]:
        """Return the cheapest borders between any two components, in canonical order.

        Returns:
            edges (N,), their costs (N,), their ends (N, 3), and the union-find of all labels.
        """
        blocks = self._map.blocks
        ends = kernels.ends_of(self._edges, blocks.neighbours, blocks.places, self._label)
        component = self._component_of_label[ends[:, 1:]].astype(np.int64)
        low, high = component.min(axis=1), component.max(axis=1)
        pair = low * (high.max(initial=0) + 1) + high
        order = np.lexsort((self._edges & 31, ends[:, 0], self._costs))
        order = order[low[order] != high[order]]
        _, first, which = np.unique(pair[order], return_index=True, return_inverse=True)
        order = order[self._costs[order] == self._costs[order][first][which]]
        parent = np.arange(self._label_count, dtype=np.int32)
        _, first, which = np.unique(
            self._component_of_label, return_index=True, return_inverse=True
        )
        parent = np.where(self._component_of_label >= 0, first[which], parent).astype(np.int32)
        return self._edges[order], self._costs[order], ends[order], parent

    def _trace(self, edge: int) -> IntArray:
        path: IntArray = kernels.trace(edge, self._map.blocks.neighbours, self._previous)
        return path

    def _joins(self, slots: IntArray, starts: IntArray, units: IntArray) -> list[Join]:
        """Return the joins whose slots lie one after the other."""
        voxels = self._map.blocks.voxels_at(slots)
        empty = self._map.empty_probability_at(voxels)
        steps = -np.log1p(-0.5 * (empty[1:] + empty[:-1]))
        bounds = pairwise([*starts.tolist(), len(slots)])
        return [
            Join(cost_nat=float(steps[a : b - 1].sum()), units=cost, voxels=voxels[a:b])
            for (a, b), cost in zip(bounds, units.tolist(), strict=True)
        ]


def add_paths(graph: SkeletonGraph, joins: list[Join], likelihood: LikelihoodMap) -> SkeletonGraph:
    """Add the paths as occluded vertices at voxel centres, tapering from end to end."""
    if not joins:
        return graph
    voxel_size_m = likelihood.voxel_size_m
    ends = distinct(np.concatenate([join.voxels[[0, -1]] for join in joins]))
    places = voxels_of(graph.vertices_in_base, voxel_size_m)
    at_ends = np.flatnonzero(VoxelIndex(ends).find(places) >= 0)[::-1]
    vertex_at = dict(zip(map(tuple, places[at_ends].tolist()), at_ends.tolist(), strict=True))
    radius = graph.radius_m.tolist()
    edges: dict[tuple[int, int], None] = {}
    added = []
    for join in joins:
        path = [tuple(voxel) for voxel in join.voxels.tolist()]
        ends_m = radius[vertex_at[path[0]]], radius[vertex_at[path[-1]]]
        taper_m = np.linspace(*ends_m, len(path)).tolist()
        for voxel, radius_m in zip(path[1:-1], taper_m[1:-1], strict=True):
            if voxel not in vertex_at:
                vertex_at[voxel] = len(radius)
                radius.append(radius_m)
                added.append(voxel)
        # The ways of a preview may run together for a while.
        steps = pairwise(vertex_at[voxel] for voxel in path)
        edges.update(dict.fromkeys((min(step), max(step)) for step in steps))
    voxels = np.array(added, dtype=np.int32).reshape(-1, 3)
    centres = np.asarray((voxels + 0.5) * voxel_size_m, dtype=np.float64)
    return SkeletonGraph(
        vertices_in_base=np.concatenate([graph.vertices_in_base, centres]),
        edges=np.concatenate([graph.edges, np.array(list(edges), dtype=np.int64).reshape(-1, 2)]),
        radius_m=np.array(radius),
        occluded=np.concatenate([graph.occluded, np.ones(len(added), dtype=bool)]),
        confidence=np.concatenate([graph.confidence, likelihood.probability_at(voxels)]),
    )


def straighten_predicted(graph: SkeletonGraph, steps: int) -> SkeletonGraph:
    """Move occluded vertices to the mean of their neighbours, `steps` times; observed ones stay.

    A voxel path is a staircase; this takes out the steps, which would bend directions and lengths.
    """
    positions: FloatArray = graph.vertices_in_base.copy()
    both = np.concatenate([graph.edges, graph.edges[:, ::-1]])
    degree = np.bincount(both[:, 0], minlength=len(positions))
    moving = np.flatnonzero(graph.occluded & (degree >= 2))
    number = np.full(len(positions), -1)
    number[moving] = np.arange(len(moving))
    at, beside = number[both[:, 0]], both[:, 1]
    at, beside = at[at >= 0], beside[at >= 0]
    for _ in range(steps):
        total = [np.bincount(at, axis, minlength=len(moving)) for axis in positions[beside].T]
        positions[moving] = np.stack(total, axis=1) / degree[moving, None]
    return replace(graph, vertices_in_base=positions)
