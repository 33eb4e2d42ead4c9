"""From accumulated line segments to the initial skeleton G_init (paper III-D)."""

from dataclasses import dataclass

import numpy as np

from canopy_skel.cluster import require_above_0
from canopy_skel.geometry import FloatArray, IntArray
from canopy_skel.graph import SkeletonGraph
from canopy_skel.kernels import forest, unions
from canopy_skel.likelihood import LikelihoodMap
from canopy_skel.strands import SmoothingConfig, Strands
from canopy_skel.voxels import VoxelIndex, grouped, voxels_of


@dataclass(frozen=True, kw_only=True, slots=True)
class InitialConfig:
    """How samples become a curve.

    Each of `smoothing_steps` moves samples to the mean of their neighbours, across the local
    direction only, Gaussian weights of `bandwidth_m` cut at twice that, neighbours within
    `max_angle_deg` of their direction. Dead ends up to `spur_m` at a fork are noise, not twigs.
    """

    smoothing_steps: int = 3
    bandwidth_m: float = 0.012
    max_angle_deg: float = 45.0
    spur_m: float = 0.02

    def __post_init__(self) -> None:
        """Refuse a bandwidth that is none."""
        require_above_0("bandwidth_m", self.bandwidth_m)

    @property
    def smoothing(self) -> SmoothingConfig:
        """What of this is about smoothing."""
        return SmoothingConfig(
            steps=self.smoothing_steps,
            bandwidth_m=self.bandwidth_m,
            max_angle_deg=self.max_angle_deg,
        )


def initial_skeleton(
    strands: Strands, likelihood: LikelihoodMap, config: InitialConfig
) -> SkeletonGraph:
    """Consolidate smoothed strands per voxel and span: the observed skeleton, many components."""
    voxel_size_m = likelihood.voxel_size_m
    vertices, radius_m = consolidate(strands, voxel_size_m)
    confidence = likelihood.probability_at(voxels_of(vertices, voxel_size_m))
    # Smoothing can carry a point out of the map, where nothing says that there is wood.
    inside = confidence > 0
    vertices, radius_m, confidence = vertices[inside], radius_m[inside], confidence[inside]
    edges = spanning_forest(vertices, voxel_size_m)
    kept, edges = prune_spurs(vertices, edges, config.spur_m)
    return SkeletonGraph(
        vertices_in_base=vertices[kept],
        edges=edges,
        radius_m=radius_m[kept],
        occluded=np.zeros(len(kept), dtype=bool),
        confidence=confidence[kept],
    )


def consolidate(strands: Strands, voxel_size_m: float) -> tuple[FloatArray, FloatArray]:
    """Return one vertex (V, 3) and its radius (V,) per voxel that holds strands, in voxel order."""
    voxels = voxels_of(strands.points_in_base, voxel_size_m)
    order, starts = grouped(voxels)
    weight = strands.weight[order]
    values = np.column_stack([strands.points_in_base, strands.radius_m])[order] * weight[:, None]
    if len(starts) == 0:
        return np.zeros((0, 3)), np.zeros(0)
    means = np.add.reduceat(values, starts, axis=0) / np.add.reduceat(weight, starts)[:, None]
    return means[:, :3].copy(), means[:, 3].copy()


def spanning_forest(points: FloatArray, voxel_size_m: float) -> IntArray:
    """Return the edges (E, 2) of the minimum spanning forest over points in neighbouring voxels.

    One point (V, 3) per voxel. The paper cuts the Euclidean tree at one voxel; with one vertex per
    voxel that limit means the 26 neighbours, whatever their distance.
    """
    voxels = voxels_of(points, voxel_size_m)
    index = VoxelIndex(voxels)
    pairs, length = forest.neighbour_pairs(points, voxels, index.top, index.origin, index.slots)
    order = np.argsort(length, kind="stable")
    edges = np.column_stack([order, pairs[order]])
    return pairs[order[unions.span(edges, np.arange(len(points), dtype=np.int32))]]


def prune_spurs(points: FloatArray, edges: IntArray, spur_m: float) -> tuple[IntArray, IntArray]:
    """Cut dead ends of at most `spur_m` off their forks, shortest first.

    Returns:
        the vertices that stay (K,), ascending; the remaining edges (E', 2) in their numbers.
    """
    both = np.concatenate([edges, edges[:, ::-1]])
    degree = np.bincount(both[:, 0], minlength=len(points))
    start = np.append(0, np.cumsum(degree))
    beside = both[np.argsort(both[:, 0], kind="stable"), 1]
    alive = np.ones(len(points), dtype=np.uint8)
    while True:
        found, length = forest.spurs(points, start, beside, degree, alive, spur_m)
        shortest_first = np.lexsort((found[:, 0], length))
        if not forest.cut(found[shortest_first], start, beside, degree, alive):
            break
    kept = np.flatnonzero(alive)
    number = np.cumsum(alive, dtype=np.int64) - 1
    return kept, number[edges[alive[edges].all(axis=1)]].reshape(-1, 2)
