"""Join what is disconnected by minimum cost paths through the map (paper III-D, Algorithm 1)."""

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from canopy_skel.geometry import FloatArray, IntArray
from canopy_skel.graph import SkeletonGraph
from canopy_skel.kernels import search
from canopy_skel.likelihood import LikelihoodGrid, VoxelIndex, voxels_of


@dataclass(frozen=True, kw_only=True, eq=False, slots=True)
class Join:
    """One path of Algorithm 1: its cost in nats and its voxels as places in the grid (n,)."""

    cost_nat: float
    nodes: IntArray


def search_paths(graph: SkeletonGraph, grid: LikelihoodGrid, index: VoxelIndex) -> list[Join]:
    """Run Algorithm 1: the cheapest path between any two subgraphs, until no more are found.

    Exact: after each join its path belongs to the subgraph, as in the paper. Ties are broken by
    (cost, length, voxel order), so the result does not depend on the order of anything.
    """
    count, component = graph.components()
    node = index.find(voxels_of(graph.vertices_in_base, grid.voxel_size_m))
    inside = np.flatnonzero(node >= 0)
    _, first = np.unique(node[inside], return_index=True)
    sources = inside[first]
    if len(sources) == 0:
        return []
    nodes, starts, costs = search.join_components(
        grid.voxels,
        grid.empty_probability(),
        index.top,
        index.origin,
        index.slots,
        node[sources],
        component[sources].astype(np.int32),
        count,
    )
    paths = np.split(nodes, starts[1:]) if len(starts) else []
    return [
        Join(cost_nat=float(cost) / search.UNITS_PER_NAT, nodes=path)
        for cost, path in zip(costs, paths, strict=True)
    ]


def add_paths(
    graph: SkeletonGraph, joins: list[Join], grid: LikelihoodGrid, index: VoxelIndex
) -> SkeletonGraph:
    """Add the paths as occluded vertices at voxel centres, as thick as the thinner of their ends.

    Where a twig meets the trunk it is the twig that goes on under the leaves.
    """
    node = index.find(voxels_of(graph.vertices_in_base, grid.voxel_size_m))
    vertex_of_node = {int(n): v for v, n in reversed(list(enumerate(node))) if n >= 0}
    radius = graph.radius_m.tolist()
    edges = graph.edges.tolist()
    added: list[int] = []
    for join in joins:
        path = join.nodes.tolist()
        ends = radius[vertex_of_node[path[0]]], radius[vertex_of_node[path[-1]]]
        for n in path[1:-1]:
            vertex_of_node[n] = len(radius)
            radius.append(min(ends))
            added.append(n)
        vertices = [vertex_of_node[n] for n in path]
        edges.extend(pairwise(vertices))
    return SkeletonGraph(
        vertices_in_base=np.concatenate(
            [graph.vertices_in_base, grid.centres_in_base()[added].reshape(-1, 3)]
        ),
        edges=np.array(edges, dtype=np.int64).reshape(-1, 2),
        radius_m=np.array(radius),
        occluded=np.concatenate([graph.occluded, np.ones(len(added), dtype=bool)]),
        confidence=np.concatenate([graph.confidence, grid.probability()[added]]),
    )


def straighten_predicted(graph: SkeletonGraph, steps: int) -> SkeletonGraph:
    """Move occluded vertices to the mean of their neighbours, `steps` times; observed ones stay.

    A voxel path is a staircase; this takes out the steps, which would bend directions and lengths.
    """
    positions: FloatArray = graph.vertices_in_base.copy()
    both = np.concatenate([graph.edges, graph.edges[:, ::-1]])
    degree = np.bincount(both[:, 0], minlength=len(positions))
    moving = graph.occluded & (degree >= 2)
    for _ in range(steps):
        total = np.zeros_like(positions)
        np.add.at(total, both[:, 0], positions[both[:, 1]])
        positions[moving] = total[moving] / degree[moving, None]
    return replace(graph, vertices_in_base=positions)
