"""From accumulated line segments to the initial skeleton G_init (paper III-D)."""

from collections import defaultdict
from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import minimum_spanning_tree

from canopy_skel.geometry import FloatArray, IntArray
from canopy_skel.graph import SkeletonGraph
from canopy_skel.kernels import smooth
from canopy_skel.likelihood import LikelihoodMap, Segments
from canopy_skel.voxels import VoxelIndex, voxels_of


@dataclass(frozen=True, kw_only=True, slots=True)
class InitialConfig:
    """How samples become a curve.

    Each of `smoothing_steps` moves a sample to the mean of its neighbours, across the local
    direction only, Gaussian weights of `bandwidth_m` cut at twice that, neighbours within
    `max_angle_deg` of its direction. Dead ends up to `spur_m` at a fork are noise, not twigs.
    """

    smoothing_steps: int = 3
    bandwidth_m: float = 0.012
    max_angle_deg: float = 45.0
    spur_m: float = 0.02


@dataclass(frozen=True, kw_only=True, eq=False, slots=True)
class Samples:
    """Points on wood: points_in_base, directions (N, 3), unit; radius_m (N,). Canonical order."""

    points_in_base: FloatArray
    directions: FloatArray
    radius_m: FloatArray


def initial_skeleton(
    segments: Segments, likelihood: LikelihoodMap, config: InitialConfig
) -> SkeletonGraph:
    """Sample, smooth, consolidate per voxel and span: the observed skeleton, many components."""
    samples = sample_segments(segments, 0.5 * likelihood.voxel_size_m)
    smoothed = smooth_across(samples, config)
    vertices, radius_m = consolidate(smoothed, likelihood.voxel_size_m)
    confidence = likelihood.probability_at(voxels_of(vertices, likelihood.voxel_size_m))
    # Smoothing can carry a point out of the map, where nothing says that there is wood.
    inside = confidence > 0
    vertices, radius_m, confidence = vertices[inside], radius_m[inside], confidence[inside]
    edges = spanning_forest(vertices, likelihood.voxel_size_m)
    kept, edges = prune_spurs(vertices, edges, config.spur_m)
    return SkeletonGraph(
        vertices_in_base=vertices[kept],
        edges=edges,
        radius_m=radius_m[kept],
        occluded=np.zeros(len(kept), dtype=bool),
        confidence=confidence[kept],
    )


def sample_segments(segments: Segments, spacing_m: float) -> Samples:
    """Put points on the segments, both ends included, no further apart than `spacing_m`.

    With at most half a voxel between them, the voxels they fall into are neighbours of each other.
    """
    direction = segments.ends_in_base - segments.starts_in_base
    length = np.linalg.norm(direction, axis=1)
    used = np.flatnonzero(length > 1e-9)
    pieces = np.ceil(length[used] / spacing_m).astype(np.int64)
    of = np.repeat(used, pieces + 1)
    first = np.repeat(np.cumsum(pieces + 1) - pieces - 1, pieces + 1)
    along = (np.arange(len(of)) - first) / np.repeat(pieces, pieces + 1)
    points = segments.starts_in_base[of] + along[:, None] * direction[of]
    directions = direction[of] / length[of, None]
    order = np.lexsort((segments.radius_m[of], *directions.T, *points.T[::-1]))
    return Samples(
        points_in_base=points[order],
        directions=directions[order],
        radius_m=segments.radius_m[of][order],
    )


def smooth_across(samples: Samples, config: InitialConfig) -> Samples:
    """Consolidate samples into curves by the neighbours' mean (paper eq. 3), made to converge.

    The paper's mean pulls points along the curve as well and collapses them into clumps; only the
    part across the local direction is applied, and the references stay where they were observed.
    """
    reach_m = 2.0 * config.bandwidth_m
    cells, cell_of = np.unique(
        voxels_of(samples.points_in_base, reach_m), axis=0, return_inverse=True
    )
    order = np.argsort(cell_of.ravel(), kind="stable")
    start = np.append(0, np.cumsum(np.bincount(cell_of.ravel(), minlength=len(cells))))
    index = VoxelIndex(cells)
    points, directions = samples.points_in_base, samples.directions
    for _ in range(config.smoothing_steps):
        points, directions = smooth.mean_shift_across(
            points,
            directions,
            samples.points_in_base[order],
            samples.directions[order],
            start,
            index.top,
            index.origin,
            index.slots,
            reach_m,
            config.bandwidth_m,
            np.cos(np.radians(config.max_angle_deg)),
        )
    return Samples(points_in_base=points, directions=directions, radius_m=samples.radius_m)


def consolidate(samples: Samples, voxel_size_m: float) -> tuple[FloatArray, FloatArray]:
    """Return one vertex (V, 3) and its radius (V,) per voxel that holds samples, in voxel order."""
    _, of = np.unique(voxels_of(samples.points_in_base, voxel_size_m), axis=0, return_inverse=True)
    values = np.column_stack([samples.points_in_base, samples.radius_m, np.ones(len(of))])
    totals = np.zeros((of.max(initial=-1) + 1, 5))
    np.add.at(totals, of.ravel(), values)
    means = totals[:, :4] / totals[:, 4:]
    return means[:, :3], means[:, 3]


def spanning_forest(points: FloatArray, voxel_size_m: float) -> IntArray:
    """Return the edges (E, 2) of the minimum spanning forest over points in neighbouring voxels.

    One point (V, 3) per voxel. The paper cuts the Euclidean tree at one voxel; with one vertex per
    voxel that limit means the 26 neighbours, whatever their distance.
    """
    voxels = voxels_of(points, voxel_size_m)
    index = VoxelIndex(voxels)
    pairs = [np.zeros((0, 2), dtype=np.int64)]
    for offset in [o for o in np.ndindex(3, 3, 3) if o > (1, 1, 1)]:
        beside = index.find((voxels + np.array(offset, dtype=np.int32) - 1).astype(np.int32))
        here = np.flatnonzero(beside >= 0)
        pairs.append(np.stack([here, beside[here]], axis=1).astype(np.int64))
    edges = np.concatenate(pairs)
    length = np.linalg.norm(points[edges[:, 0]] - points[edges[:, 1]], axis=1)
    # A weight of exactly 0 would be no edge to the library.
    weights = coo_array((np.maximum(length, 1e-12), edges.T), shape=(len(points),) * 2)
    forest = minimum_spanning_tree(weights.tocsr()).tocoo()
    return np.stack([forest.row, forest.col], axis=1).astype(np.int64)


def prune_spurs(points: FloatArray, edges: IntArray, spur_m: float) -> tuple[IntArray, IntArray]:
    """Cut dead ends of at most `spur_m` off their forks, shortest first.

    Returns:
        the vertices that stay (K,), ascending; the remaining edges (E', 2) in their numbers.
    """
    neighbours: dict[int, set[int]] = defaultdict(set)
    for a, b in edges.tolist():
        neighbours[a].add(b)
        neighbours[b].add(a)
    gone: set[int] = set()
    while True:
        spurs = sorted(
            spur
            for tip in [v for v, others in neighbours.items() if len(others) == 1]
            if (spur := _spur_from(tip, neighbours, points, spur_m)) is not None
        )
        cut = False
        for _, path in spurs:
            *twig, fork = path
            if len(neighbours[fork]) >= 3:
                neighbours[fork].remove(twig[-1])
                for vertex in twig:
                    del neighbours[vertex]
                gone.update(twig)
                cut = True
        if not cut:
            break
    kept = np.array([v for v in range(len(points)) if v not in gone], dtype=np.int64)
    number = np.full(len(points), -1)
    number[kept] = np.arange(len(kept))
    remaining = number[edges]
    return kept, remaining[(remaining >= 0).all(axis=1)]


def _spur_from(
    tip: int, neighbours: dict[int, set[int]], points: FloatArray, spur_m: float
) -> tuple[float, list[int]] | None:
    """Return (length, vertices from tip to fork) when the fork is no further than `spur_m`."""
    path, length = [tip], 0.0
    while len(neighbours[path[-1]]) < 3:
        onward = neighbours[path[-1]] - set(path[-2:-1])
        if not onward:
            return None
        path.append(onward.pop())
        length += float(np.linalg.norm(points[path[-1]] - points[path[-2]]))
        if length > spur_m:
            return None
    return length, path
