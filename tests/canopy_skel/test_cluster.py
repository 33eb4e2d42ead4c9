from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from oracles import naive_cluster

from canopy_skel.cluster import ClusterConfig, cluster_branches, principal_axes
from canopy_skel.errors import UsageError, ViewError
from canopy_skel.frame import Intrinsics, View
from canopy_skel.kernels.parts import parts_of, shapes_of
from canopy_skel.kernels.strip import measure
from canopy_skel.pieces import PieceConfig
from canopy_skel.segmenters.recorded import RecordedSegmenter

LENS = Intrinsics(fx_px=400, fy_px=400, cx_px=160, cy_px=100, width_px=320, height_px=200)
CONFIG = ClusterConfig()


def view_with(depth_m, instances, scores=(0.9,), pose=None):
    return View(
        index=3,
        stamp_ns=1,
        color_rgb=np.zeros((200, 320, 3), np.uint8),
        intrinsics=LENS,
        base_from_camera=np.eye(4) if pose is None else pose,
        depth_m=None if depth_m is None else depth_m.astype(np.float32),
        instances=instances.astype(np.uint16),
        scores=scores,
    )


def stick(slope=0.0):
    """A branch 8 px wide across the picture at 1 m, its depth rising by `slope` m along it."""
    depth_m, instances = np.full((200, 320), np.nan), np.zeros((200, 320))
    columns = np.arange(60, 260)
    instances[96:104, 60:260] = 1
    depth_m[96:104, 60:260] = 1.0 + slope * (columns - 60) / 200
    return depth_m, instances


def clusters_of(depth_m, instances, **kwargs):
    view = view_with(depth_m, instances, **kwargs)
    return cluster_branches(view, RecordedSegmenter().segment(view), CONFIG)


def test_a_branch_becomes_its_visible_points():
    clusters, rejected = clusters_of(*stick())
    assert rejected == []
    (cluster,) = clusters
    assert (cluster.view_index, cluster.instance, cluster.confidence) == (3, 1, 0.9)
    assert len(cluster.points_in_base) == 6 * 198
    np.testing.assert_allclose(cluster.points_in_base[:, 2], 1.0, atol=1e-6)
    np.testing.assert_allclose(np.ptp(cluster.points_in_base[:, 0]), 197 / 400, atol=1e-6)
    tangent = 4 / 400
    assert cluster.half_width_m == pytest.approx(tangent / (1 - np.pi / 4 * tangent), rel=0.02)


@pytest.mark.parametrize("angle_deg", [0, 30, 75, 90, 140])
@pytest.mark.parametrize("radius_px", [2.0, 5.0, 20.0])
def test_the_outline_tells_the_radius_whatever_the_slope(angle_deg, radius_px):
    masks = strip(angle_deg, radius_px)
    assert width_px(masks) == pytest.approx(2 * radius_px, rel=0.12)


@pytest.mark.parametrize("angle_deg", [0, 30, 75, 90, 140])
def test_leaves_over_a_third_of_the_edge_do_not_make_wood_thin(angle_deg):
    whole = strip(angle_deg, 8.0)
    bitten = whole.copy()
    along, across = axes_of(angle_deg)
    bitten[(across > -2) & (np.abs(along) < 30)] = False
    assert width_px(bitten) == pytest.approx(16.0, rel=0.08)


def test_wood_of_which_only_both_ends_show_has_a_width():
    mask = np.zeros((5, 100), np.bool_)
    mask[:4, :5] = mask[:4, -5:] = True
    strip = np.empty(5)
    measure(mask, strip)
    assert strip[0] == pytest.approx(2.0, rel=0.25)


def test_wood_at_the_edge_of_the_picture_is_no_thicker():
    """The picture stretches what lies far off its axis; the ray sees the wood's own width."""
    radius_m, wide = (
        0.02,
        Intrinsics(fx_px=400, fy_px=400, cx_px=160, cy_px=100, width_px=800, height_px=200),
    )
    foot = np.array([1.2, 0.0, 1.0])
    v, u = np.indices((200, 800))
    rays = wide.back_project(u.ravel(), v.ravel(), np.ones(u.size))
    normal = np.cross(rays, [0.0, 1.0, 0.0])
    apart = np.abs(normal @ foot) / np.linalg.norm(normal, axis=1)
    wood = (apart < radius_m).reshape(200, 800)
    view = View(
        index=0,
        stamp_ns=1,
        color_rgb=np.zeros((200, 800, 3), np.uint8),
        intrinsics=wide,
        base_from_camera=np.eye(4),
        depth_m=np.where(wood, 1.0 - np.pi / 4 * radius_m, np.nan).astype(np.float32),
        instances=wood.astype(np.uint16),
        scores=(0.9,),
    )
    (cluster,), _ = cluster_branches(view, RecordedSegmenter().segment(view), CONFIG)
    assert cluster.half_width_m == pytest.approx(radius_m, rel=0.04)


def axes_of(angle_deg):
    """Return how far along and across a line through the middle each pixel lies."""
    v, u = np.indices((200, 320)) - np.array([100.3, 160.4])[:, None, None]
    cosine, sine = np.cos(np.radians(angle_deg)), np.sin(np.radians(angle_deg))
    return u * cosine + v * sine, v * cosine - u * sine


def strip(angle_deg, radius_px):
    along, across = axes_of(angle_deg)
    return (np.abs(across) < radius_px) & (np.abs(along) < 90)


def width_px(mask):
    found = np.empty(5)
    measure(mask, found)
    return 2 * found[0]


def test_leaves_in_front_and_background_behind_are_cut_from_a_tilted_branch():
    depth_m, instances = stick(slope=0.3)
    truth = depth_m.copy()
    depth_m[96:104, 90:110] = 0.8
    depth_m[96:104, 180:200] = 2.5
    clusters, _ = clusters_of(depth_m, instances)
    points = np.concatenate([cluster.points_in_base for cluster in clusters])
    u = points[:, 0] / points[:, 2] * 400 + 160
    expected = truth[100, np.round(u).astype(int)]
    assert np.abs(points[:, 2] - expected).max() < 0.02
    assert len(points) == 6 * (198 - 40)


def test_a_mask_whose_depth_is_mostly_of_something_else_is_rejected():
    depth_m, instances = stick()
    depth_m[96:104, 60:200] = np.random.default_rng(1).uniform(0.5, 4.0, (8, 140))
    clusters, rejected = clusters_of(depth_m, instances)
    assert clusters == []
    assert [(r.view_index, r.instance) for r in rejected] == [(3, 1)]
    assert "too few points" in rejected[0].reason


def test_a_hole_in_depth_splits_a_mask_and_each_part_keeps_the_score():
    depth_m, instances = stick()
    depth_m[96:104, 150:185] = np.nan
    clusters, _ = clusters_of(depth_m, instances)
    assert [c.confidence for c in clusters] == [0.9, 0.9]
    assert {c.instance for c in clusters} == {1}


def test_a_blob_is_not_a_branch():
    depth_m, instances = np.full((200, 320), np.nan), np.zeros((200, 320))
    instances[80:120, 140:180] = 1
    depth_m[80:120, 140:180] = 1.0
    clusters, rejected = clusters_of(depth_m, instances)
    assert clusters == []
    assert [r.reason for r in rejected] == ["not slender"]


def test_what_fills_more_than_90_degrees_of_view_has_no_thickness():
    """Beyond 1.27 focal lengths the formula of the outline turns negative."""
    lens = Intrinsics(fx_px=35, fy_px=35, cx_px=160, cy_px=100, width_px=320, height_px=200)
    instances = np.zeros((200, 320), np.uint16)
    instances[60:140, 10:310] = 1
    view = View(
        index=0,
        stamp_ns=0,
        color_rgb=np.zeros((200, 320, 3), np.uint8),
        intrinsics=lens,
        base_from_camera=np.eye(4),
        depth_m=np.full((200, 320), 0.4, np.float32),
        instances=instances,
        scores=(0.9,),
    )
    clusters, rejected = cluster_branches(view, RecordedSegmenter().segment(view), CONFIG)
    assert clusters == []
    assert [r.reason for r in rejected] == ["wider than 90 degrees"]


def test_what_is_thicker_than_a_branch_is_none():
    depth_m, instances = np.full((200, 320), 2.9), np.zeros((200, 320))
    instances[70:130, 10:310] = 1
    clusters, rejected = clusters_of(depth_m, instances)
    assert clusters == []
    assert [r.reason for r in rejected] == ["thicker than a branch"]


@pytest.mark.parametrize("config", [ClusterConfig, PieceConfig])
@pytest.mark.parametrize("nearest_m", [0.0, -1.0, np.nan, 3.0])
def test_a_range_of_depth_begins_beyond_no_depth(config, nearest_m):
    """A depth of 0 stands for none; its disparity would be infinite."""
    with pytest.raises(UsageError, match="nearest above 0"):
        config(nearest_m=nearest_m, farthest_m=3.0)


def test_points_are_in_base():
    pose = np.array([[0, 0, 1, 0.5], [-1, 0, 0, 0.1], [0, -1, 0, 0.2], [0, 0, 0, 1]], float)
    (here,), _ = clusters_of(*stick())
    (there,), _ = clusters_of(*stick(), pose=pose)
    np.testing.assert_allclose(
        there.points_in_base, here.points_in_base @ pose[:3, :3].T + pose[:3, 3], atol=1e-9
    )
    np.testing.assert_array_equal(there.camera_in_base, pose[:3, 3])


def test_a_view_without_depth_says_what_to_do():
    with pytest.raises(ViewError, match=r"view 3: no depth; compute it from the stereo pair"):
        clusters_of(None, stick()[1])


@pytest.mark.parametrize("far_m", [1.0, 3e4])
def test_parts_that_are_far_apart_take_no_room_between_them(far_m):
    spot = np.linspace(0.0, 0.05, 10)[:, None] * [1.0, 1.0, 1.0]
    part, group = parts_of(np.concatenate([spot + far_m, spot]), np.array([0, 0, 20]), 0.03)
    assert part.tolist() == [1] * 10 + [0] * 10
    assert group.tolist() == [1, 1]


@pytest.mark.parametrize(
    "wrong",
    [
        {"fx_px": np.nan},
        {"fy_px": np.inf},
        {"fx_px": 0.0},
        {"fy_px": -400.0},
        {"fx_px": 1e-9},
        {"cx_px": np.nan},
        {"cy_px": -1e30},
        {"cx_px": 641.0},
        {"fx_px": 0.69, "fy_px": 0.69, "cx_px": 0.5, "cy_px": 0.5},
    ],
)
def test_a_view_with_intrinsics_that_no_camera_has_is_refused(wrong):
    """Its points would lie so far away that their cells could not be numbered."""
    depth_m, instances = stick()
    with pytest.raises(ViewError, match=r"view 0: [fc]x = .*; give the calibration"):
        View(
            index=0,
            stamp_ns=0,
            color_rgb=np.zeros((200, 320, 3), np.uint8),
            intrinsics=replace(LENS, **wrong),
            base_from_camera=np.eye(4),
            depth_m=depth_m.astype(np.float32),
            instances=instances.astype(np.uint16),
            scores=(0.9,),
        )


def test_a_thin_mask_is_not_eroded_away():
    depth_m, instances = stick()
    instances[:] = 0
    instances[99:101, 60:260] = 1
    (cluster,), _ = clusters_of(depth_m, instances)
    assert len(cluster.points_in_base) == 2 * 200


def test_no_masks_give_no_clusters():
    assert clusters_of(stick()[0], np.zeros((200, 320)), scores=()) == ([], [])


def cluttered(seed):
    """A few branches, bent and across one another, with noise, leaves, holes and a blob."""
    random = np.random.default_rng(seed)
    depth_m, instances = np.full((200, 320), 2.5), np.zeros((200, 320))
    rows, columns = np.mgrid[:200, :320]
    count = int(random.integers(1, 7))
    for number in range(1, count + 1):
        middle, angle = random.uniform((40, 40), (160, 280)), random.uniform(0, np.pi)
        along = (columns - middle[1]) * np.cos(angle) + (rows - middle[0]) * np.sin(angle)
        across = (rows - middle[0]) * np.cos(angle) - (columns - middle[1]) * np.sin(angle)
        half = random.uniform((1, 8), (9, 120))
        inside = (np.abs(across) < half[0]) & (np.abs(along) < half[1])
        instances[inside] = number
        slope, at_m = random.uniform(-2e-3, 2e-3), random.uniform(0.5, 1.6)
        depth_m[inside] = (at_m + slope * along + random.normal(0, 0.002, along.shape))[inside]
    for _ in range(int(random.integers(0, 20))):
        v, u = random.integers(0, 180), random.integers(0, 290)
        leaf = random.choice([np.nan, random.uniform(0.2, 6.0)])
        depth_m[v : v + random.integers(3, 20), u : u + random.integers(3, 30)] = leaf
    return depth_m, instances, tuple(random.uniform(0.3, 1.0, count))


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=60)
def test_all_masks_at_once_are_one_mask_after_the_other(seed):
    depth_m, instances, scores = cluttered(seed)
    view = view_with(depth_m, instances, scores)
    masks = RecordedSegmenter().segment(view)
    clusters, rejected = cluster_branches(view, masks, CONFIG)
    for mask in masks:
        expected, reasons = naive_cluster.clusters_of_mask(view, mask, CONFIG)
        mine = [c for c in clusters if c.instance == mask.instance]
        assert [len(c.points_in_base) for c in mine] == [len(points) for points, _ in expected]
        for cluster, (points, width_m) in zip(mine, expected, strict=True):
            np.testing.assert_allclose(cluster.points_in_base, points, rtol=1e-12)
            assert cluster.half_width_m == pytest.approx(width_m, rel=1e-12)
        assert [r.reason for r in rejected if r.instance == mask.instance] == reasons


@given(st.integers(0, 2**32 - 1))
def test_axes_do_not_depend_on_the_order_of_points(seed):
    random = np.random.default_rng(seed)
    points = random.normal(size=(50, 3)) * [0.2, 0.05, 0.01]
    deviation, axes = principal_axes(points)
    _, again = principal_axes(points[random.permutation(50)])
    np.testing.assert_allclose(axes, again, atol=1e-9)
    np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-9)
    assert (np.diff(deviation) <= 0).all()


@given(st.integers(0, 2**32 - 1), st.integers(2, 6))
def test_a_straight_row_of_points_is_no_blob_and_one_spot_is(seed, count):
    rng = np.random.default_rng(seed)
    row = rng.normal(0.0, 0.3, 3) + np.outer(np.arange(count), rng.normal(0.0, 0.01, 3))
    spot = np.repeat(row[:1], count, axis=0)
    shapes = shapes_of(np.concatenate([row, spot]), np.array([0, count, 2 * count]))
    assert shapes[0, 0] < 1e-3
    assert shapes[1, 0] == 1.0
    np.testing.assert_allclose(shapes[:, 1], [np.median(row[:, 2]), row[0, 2]])
