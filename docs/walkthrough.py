"""The method step by step on one recording, and the places worth a figure: for figures.py."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from canopy_skel.baselines.ftsem import join_break_points
from canopy_skel.baselines.mst import join_by_spanning_tree
from canopy_skel.cluster import (
    BranchCluster,
    cluster_branches,
    follow_profiles,
    principal_axes,
    usable_pixels,
)
from canopy_skel.document import RejectedView, from_json
from canopy_skel.frame import View
from canopy_skel.geometry import FloatArray, IntArray
from canopy_skel.graph import SkeletonGraph
from canopy_skel.initial import initial_skeleton
from canopy_skel.likelihood import LikelihoodGrid, LikelihoodMap, Segments, segments_of
from canopy_skel.pathsearch import Join, PathSearch, add_paths, straighten_predicted
from canopy_skel.pipeline import MethodConfig
from canopy_skel.recording import read_recording
from canopy_skel.segment import BranchMask
from canopy_skel.segmenters.recorded import RecordedSegmenter
from canopy_skel.spline import BranchSpline, fit_splines
from canopy_skel.strands import StrandMap, Strands, sample_segments
from drivers.stereo import with_depth

CONFIG = MethodConfig(name="paper")


@dataclass(frozen=True, kw_only=True, eq=False, slots=True)
class Instance:
    """One mask and the single cluster and spline it gave."""

    view: View
    mask: BranchMask
    cluster: BranchCluster
    spline: BranchSpline


@dataclass(frozen=True, kw_only=True, eq=False, slots=True)
class Walk:
    """Every intermediate result of the method on one recording."""

    scan_id: str
    views: list[View]
    instances: list[Instance]
    segments: Segments
    grid: LikelihoodGrid
    smoothed: Strands
    initial: SkeletonGraph
    joins: list[Join]
    results: dict[str, SkeletonGraph]
    truth: SkeletonGraph | None

    def flat(self, points_in_base: FloatArray) -> FloatArray:
        """Return (N, 2): the two base axes that the cameras look across."""
        return points_in_base[:, self.shown]

    @property
    def shown(self) -> list[int]:
        """The two base axes of the pictures; the third is the one the cameras look along."""
        forward = np.mean([view.base_from_camera[:3, 2] for view in self.views], axis=0)
        return [axis for axis in range(3) if axis != np.argmax(np.abs(forward))]

    @property
    def hidden(self) -> int:
        """The base axis the cameras look along."""
        return 3 - sum(self.shown)


def walk_through(path: Path) -> Walk:
    """Run the method as canopy_skel/pipeline.py does, and keep what it lets go of."""
    recording = read_recording(path)
    views = [with_depth(v) for v in recording.views() if not isinstance(v, RejectedView)]
    likelihood = LikelihoodMap(CONFIG.likelihood)
    strands = StrandMap(CONFIG.likelihood.voxel_size_m, CONFIG.initial.smoothing)
    splines: list[BranchSpline] = []
    instances: list[Instance] = []
    for view in views:
        for mask in RecordedSegmenter().segment(view):
            clusters, _ = cluster_branches(view, [mask], CONFIG.cluster)
            fitted = fit_splines(clusters, CONFIG.spline)
            splines += fitted
            likelihood.add(segments_of(fitted))
            strands.add(segments_of(fitted))
            if len(clusters) == 1:
                one = Instance(view=view, mask=mask, cluster=clusters[0], spline=fitted[0])
                instances.append(one)
    segments, grid = segments_of(splines), likelihood.grid()
    smoothed = strands.smoothed()
    initial = initial_skeleton(smoothed, likelihood, CONFIG.initial)
    search = PathSearch(likelihood)
    search.update(initial)
    joins = search.joins()
    paper = straighten_predicted(add_paths(initial, joins, likelihood), CONFIG.straighten_steps)
    voxel_m = grid.voxel_size_m
    results = {
        "paper": paper,
        "mst": join_by_spanning_tree(initial, voxel_m),
        "ftsem": join_break_points(initial, voxel_m, CONFIG.ftsem),
    }
    return Walk(
        scan_id=recording.scan_id,
        views=views,
        instances=instances,
        segments=segments,
        grid=grid,
        smoothed=smoothed,
        initial=initial,
        joins=joins,
        results=results,
        truth=truth_of(recording.ground_truth),
    )


def truth_of(data: bytes | None) -> SkeletonGraph | None:
    """Return the attached true skeleton as a graph."""
    if data is None:
        return None
    document = from_json(data)
    steps = [np.column_stack([b.vertices[:-1], b.vertices[1:]]) for b in document.branches]
    return SkeletonGraph(
        vertices_in_base=document.position,
        edges=np.concatenate(steps),
        radius_m=document.radius,
        occluded=document.occluded,
        confidence=document.confidence,
    )


def busiest_view(walk: Walk) -> View:
    """Return the view with the most single-cluster masks."""
    counts = {view.index: 0 for view in walk.views}
    for one in walk.instances:
        counts[one.view.index] += 1
    return max(walk.views, key=lambda view: counts[view.index])


def profile_of(one: Instance) -> tuple[IntArray, IntArray, FloatArray, FloatArray, FloatArray]:
    """Return rows, columns, place along the mask, disparity and trust of a mask's pixels."""
    usable = usable_pixels(one.view.depth_m, [one.mask], CONFIG.cluster)
    u, v, depth_m = usable.pixels.T
    centred = usable.pixels[:, :2] - usable.pixels[:, :2].mean(axis=0)
    along = centred @ np.linalg.svd(centred, full_matrices=False)[2][0]
    trusted = follow_profiles(usable, CONFIG.cluster)
    return v.astype(np.int64), u.astype(np.int64), along, 1.0 / depth_m, trusted


def telling_instance(walk: Walk) -> Instance:
    """Return a long thick instance of which much is cut, so that filter and shift can be seen."""

    def worth(one: Instance) -> tuple[bool, float]:
        *_, trusted = profile_of(one)
        cut = float(np.mean(~trusted))
        deviation, _ = principal_axes(one.cluster.points_in_base)
        fits = deviation[1] < 0.15 * deviation[0] and cut >= 0.05
        return fits, min(cut, 0.2) * one.spline.radius_m * float(len(trusted)) ** 0.5

    return max(walk.instances, key=worth)


def path_points(walk: Walk, join: Join) -> FloatArray:
    """Return the voxel centres (n, 3) of a path of Algorithm 1."""
    return np.asarray((join.voxels + 0.5) * walk.grid.voxel_size_m)


def gap_m(walk: Walk, join: Join) -> float:
    """Return the straight distance between the ends of a path."""
    ends = path_points(walk, join)[[0, -1]]
    return float(np.linalg.norm(ends[1] - ends[0]))


def telling_join(walk: Walk) -> Join:
    """Return a join across a gap of 80 to 250 mm in the plane shown, at about 0.1 nat a step."""

    def worth(join: Join) -> tuple[bool, float]:
        ends = path_points(walk, join)[[0, -1]]
        seen = np.linalg.norm(walk.flat(ends)[1] - walk.flat(ends)[0])
        fits = 0.08 <= gap_m(walk, join) <= 0.25 and seen >= 0.85 * gap_m(walk, join)
        return fits, -abs(float(np.log10(join.cost_nat / len(join.voxels) + 1e-4)) + 1.0)

    return max(walk.joins, key=worth)


def strongest_segments(segments: Segments, points: FloatArray, k: float) -> IntArray:
    """Return all segments, those first that give points (n, 3) most p_o on average (eq. 1)."""
    direction = segments.ends_in_base - segments.starts_in_base
    length = np.maximum(np.linalg.norm(direction, axis=1), 1e-9)
    axis = direction / length[:, None]
    offset = points[:, None] - segments.starts_in_base
    along = (offset * axis).sum(axis=2)
    past = np.maximum(0.0, np.maximum(-along, along - length)) / length
    aside = np.linalg.norm(offset - along[..., None] * axis, axis=2) / segments.radius_m
    likelihood = segments.confidence * np.maximum(0.0, 1 - np.hypot(past, aside) / k)
    return np.argsort(-likelihood.mean(axis=0), kind="stable")


def busiest_fork(walk: Walk) -> FloatArray:
    """Return the fork of the initial skeleton around which most segments were seen."""
    degree = np.bincount(walk.initial.edges.ravel(), minlength=len(walk.initial.vertices_in_base))
    forks = walk.initial.vertices_in_base[degree >= 3]
    samples = sample_segments(walk.segments, 0.5 * walk.grid.voxel_size_m)[0]
    near = [(np.linalg.norm(samples - fork, axis=1) < 0.08).sum() for fork in forks]
    return np.asarray(forks[int(np.argmax(near))])


def greatest_difference(walk: Walk) -> FloatArray:
    """Return the predicted vertex near which most is predicted that another method has not."""
    lone = []
    for graph in walk.results.values():
        predicted = graph.vertices_in_base[graph.occluded]
        for other in walk.results.values():
            distance_m, _ = cKDTree(other.vertices_in_base).query(predicted)
            lone.append(predicted[distance_m > 0.02])
    places = np.concatenate(lone)
    tree = cKDTree(places)
    return np.asarray(places[np.argmax(tree.query_ball_point(places, 0.25, return_length=True))])
