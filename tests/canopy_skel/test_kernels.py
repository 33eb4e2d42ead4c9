"""Every kernel on a scene so small that it can also run uncompiled (test_uncompiled.py)."""

import numpy as np
import pytest
from oracles import naive_cluster, naive_likelihood, naive_pathsearch
from scipy.interpolate import make_lsq_spline

from canopy_skel.cluster import BranchCluster, ClusterConfig, cluster_branches, principal_axes
from canopy_skel.frame import Intrinsics, View
from canopy_skel.initial import InitialConfig, initial_skeleton
from canopy_skel.kernels.sums import UNITS_PER_NAT
from canopy_skel.likelihood import LikelihoodConfig, LikelihoodMap, Segments
from canopy_skel.pathsearch import PathSearch
from canopy_skel.segmenters.recorded import RecordedSegmenter
from canopy_skel.spline import SplineConfig, fit_splines
from canopy_skel.strands import StrandMap

VOXEL = 0.02
STICKS = [
    ((0.01, 0.013, 0.017), (0.07, 0.019, 0.021), 0.006, 0.9),
    ((0.17, 0.011, 0.023), (0.23, 0.017, 0.033), 0.006, 0.8),
    ((0.113, -0.081, 0.003), (0.109, -0.031, 0.019), 0.007, 0.7),
]


def segments_from(rows):
    starts, ends, radii, confidences = zip(*rows, strict=True)
    return Segments(
        starts_in_base=np.array(starts),
        ends_in_base=np.array(ends),
        radius_m=np.array(radii),
        confidence=np.array(confidences),
    )


class Scene:
    def __init__(self):
        self.likelihood = LikelihoodMap(LikelihoodConfig(voxel_size_m=VOXEL))
        self.strands = StrandMap(VOXEL, InitialConfig().smoothing)
        self.search = PathSearch(self.likelihood)

    def change(self, row, sign=1):
        segments = segments_from([row])
        for part in (self.likelihood, self.strands):
            part.add(segments) if sign > 0 else part.remove(segments)

    def update(self):
        graph = initial_skeleton(self.strands.smoothed(), self.likelihood, InitialConfig())
        self.search.update(graph)
        return graph

    def state(self):
        grid = self.likelihood.grid()
        slots = self.likelihood.blocks.slots_of(grid.voxels)
        ways = self.search.distances[slots].tolist()
        joins = [(join.units, join.voxels.tolist()) for join in self.search.joins()]
        spare = [(join.units, join.voxels.tolist()) for join in self.search.preview()]
        return grid.voxels.tolist(), grid.units.tolist(), ways, joins, spare


def literal(scene, graph):
    grid = scene.likelihood.grid()
    levels = {
        tuple(v): naive_pathsearch.level(int(n))
        for v, n in zip(grid.voxels.tolist(), grid.units, strict=True)
    }
    _, label = graph.components()
    voxels = np.floor(graph.vertices_in_base / VOXEL).astype(int).tolist()
    components = [
        [tuple(v) for v, of in zip(voxels, label, strict=True) if of == one]
        for one in range(max(label) + 1)
    ]
    return naive_pathsearch.join_paths(levels, components)


def test_the_map_is_the_formula_whatever_was_added_and_taken_off():
    scene = Scene()
    for row in STICKS:
        scene.change(row)
    scene.change(STICKS[0], -1)
    grid = scene.likelihood.grid()
    low, high = (-6, -14, -8), (22, 8, 10)
    inside = ((grid.voxels >= low) & (grid.voxels < high)).all(axis=1)
    dense = np.zeros(np.subtract(high, low))
    dense[tuple((grid.voxels - low)[inside].T)] = grid.probability()[inside]
    left = segments_from(STICKS[1:])
    expected = naive_likelihood.likelihood(left, VOXEL, 3.0, 0.999, low, high)
    np.testing.assert_allclose(dense, expected, atol=4 / UNITS_PER_NAT)


def test_repaired_searches_are_searches_from_scratch_and_literal():
    scene = Scene()
    steps = [(0, 1), (1, 1), (2, 1), (1, -1), (1, 1), (0, 1), (0, -1)]
    known = []
    for which, sign in steps:
        scene.change(STICKS[which], sign)
        known.append((which, sign))
        graph = scene.update()
        other = Scene()
        for again in sorted(known, key=lambda step: -step[1]):
            other.change(STICKS[again[0]], again[1])
        other.update()
        assert scene.state() == other.state()
        assert scene.state() == scene.state()
        paths = [[tuple(v) for v in join.voxels.tolist()] for join in scene.search.joins()]
        assert paths == literal(scene, graph)
    assert len(paths) == 2


def test_clusters_are_those_of_one_mask_after_the_other():
    depth_m, instances = np.full((30, 60), 1.5, np.float32), np.zeros((30, 60), np.uint16)
    depth_m += np.random.default_rng(0).normal(0, 0.003, depth_m.shape).astype(np.float32)
    instances[4:9, 2:50], instances[14:16, 5:40], instances[18:28, 20:31] = 1, 2, 3
    depth_m[4:9, 20:26], depth_m[14:16, 8:10] = 0.9, np.nan
    lens = Intrinsics(fx_px=80, fy_px=80, cx_px=30, cy_px=15, width_px=60, height_px=30)
    view = View(
        index=0,
        stamp_ns=0,
        color_rgb=np.zeros((30, 60, 3), np.uint8),
        intrinsics=lens,
        base_from_camera=np.eye(4),
        depth_m=depth_m,
        instances=instances,
        scores=(0.9, 0.8, 0.7),
    )
    masks, config = RecordedSegmenter().segment(view), ClusterConfig()
    clusters, rejected = cluster_branches(view, masks, config)
    expected = [naive_cluster.clusters_of_mask(view, mask, config) for mask in masks]
    np.testing.assert_allclose(
        np.concatenate([cluster.points_in_base for cluster in clusters]),
        np.concatenate([points for found, _ in expected for points, _ in found]),
    )
    assert [one.reason for one in rejected] == [r for _, reasons in expected for r in reasons]
    assert [one.reason for one in rejected] == ["part too small", "not slender"]


@pytest.mark.parametrize("shape", ["bowed", "line", "twice the same points", "two clumps"])
def test_splines_are_those_of_the_library(shape):
    along = np.linspace(0, 0.2, 40)
    points = np.stack([along, 0.4 * along**2, -0.1 * along], axis=1)
    points += np.random.default_rng(0).normal(0, 0.001, points.shape)
    if shape == "line":
        points = np.stack([along, 0.5 * along, 0 * along], axis=1)
    if shape == "twice the same points":
        points = np.tile(points, (2, 1))
    if shape == "two clumps":
        points = points[(along < 0.01) | (along > 0.19)]
    one = BranchCluster(
        view_index=0,
        instance=1,
        confidence=0.8,
        half_width_m=0.0,
        camera_in_base=np.array([0.0, 0.0, -1.0]),
        points_in_base=points,
    )
    spline = fit_splines([one, one], SplineConfig(centre_shift=0.0))[1]
    t = (points - points.mean(axis=0)) @ principal_axes(points)[1][0]
    order = np.argsort(t)
    count = len(spline.control_points_in_base)
    knots = np.linspace(t.min(), t.max(), count)
    knots = np.r_[knots[0], knots, knots[-1]]
    expected = make_lsq_spline(t[order], points[order], knots, k=1)
    assert count == (2 if shape == "two clumps" else 4)
    np.testing.assert_allclose(spline.control_points_in_base, expected.c, atol=1e-9)
