"""The paper's second baseline: break points joined by distance and angle (FTSEM, section IV).

After "Fast tree skeleton extraction using voxel thinning based on tree point cloud" (Sun et al.
2022), whose break point connection the paper describes; its limits are not given there.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.cluster.hierarchy import DisjointSet
from scipy.spatial import cKDTree

from canopy_skel.baselines.mst import UNKNOWN
from canopy_skel.geometry import FloatArray
from canopy_skel.graph import SkeletonGraph, add_bridges


@dataclass(frozen=True, kw_only=True, slots=True)
class FtsemConfig:
    """Break points are joined across at most `max_gap_m`.

    Both the vector of the end and the gap, and the vectors of two ends that face each other, may
    differ by `max_angle_deg`. An end's vector is taken over its last `end_length_m`.
    """

    max_gap_m: float = 0.15
    max_angle_deg: float = 45.0
    end_length_m: float = 0.03


def join_break_points(graph: SkeletonGraph, spacing_m: float, config: FtsemConfig) -> SkeletonGraph:
    """Join ends to other components, shortest gap first, while it makes no cycle."""
    _, component = graph.components()
    joined = DisjointSet(np.unique(component).tolist())
    used: set[int] = set()
    pairs = []
    for _, end, other in sorted(_candidates(graph, config)):
        a, b = int(component[end]), int(component[other])
        if end not in used and not joined.connected(a, b):
            joined.merge(a, b)
            used.add(end)
            pairs.append((end, other))
    return add_bridges(graph, np.array(pairs, dtype=np.int64).reshape(-1, 2), spacing_m, UNKNOWN)


def _candidates(graph: SkeletonGraph, config: FtsemConfig) -> Iterator[tuple[float, int, int]]:
    """Yield (gap, end, other vertex) that meet the conditions on distance and angles."""
    points, (_, component) = graph.vertices_in_base, graph.components()
    vectors = end_vectors(graph, config.end_length_m)
    tree, limit = cKDTree(points), np.cos(np.radians(config.max_angle_deg))
    for end, vector in vectors.items():
        near = np.array(tree.query_ball_point(points[end], config.max_gap_m))
        near = near[component[near] != component[end]]
        gap = points[near] - points[end]
        gap_m = np.maximum(np.linalg.norm(gap, axis=1), 1e-12)
        ahead = gap @ vector >= limit * gap_m
        for other, distance in zip(near[ahead].tolist(), gap_m[ahead].tolist(), strict=True):
            facing = vectors.get(other)
            if facing is None or -facing @ vector >= limit:
                yield distance, end, other


def end_vectors(graph: SkeletonGraph, length_m: float) -> dict[int, FloatArray]:
    """Return the outward unit vector of each end, over the last `length_m` or up to a fork."""
    neighbours: list[list[int]] = [[] for _ in graph.vertices_in_base]
    for a, b in graph.edges.tolist():
        neighbours[a].append(b)
        neighbours[b].append(a)
    vectors = {}
    for end in [v for v, others in enumerate(neighbours) if len(others) == 1]:
        before, at = end, neighbours[end][0]
        offset = graph.vertices_in_base[end] - graph.vertices_in_base[at]
        while len(neighbours[at]) == 2 and np.linalg.norm(offset) < length_m:
            before, at = at, next(v for v in neighbours[at] if v != before)
            offset = graph.vertices_in_base[end] - graph.vertices_in_base[at]
        vectors[end] = offset / max(float(np.linalg.norm(offset)), 1e-12)
    return vectors
