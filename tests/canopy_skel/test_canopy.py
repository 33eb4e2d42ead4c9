from dataclasses import asdict, replace
from itertools import permutations
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scenes.leaves import GAP, leafy_view
from scenes.wood import WOOD, view_from

from canopy_skel.canopy import CanopyConfig, CanopyScan, canopy_config_from, piece_means
from canopy_skel.confidence import (
    shipped_models,
)
from canopy_skel.document import Method, build_document, from_json, to_json
from canopy_skel.errors import UsageError
from canopy_skel.evidence import HIDDEN, count_evidence, evidence_of, is_empty
from canopy_skel.evidence import WOOD as WOOD_SEEN
from canopy_skel.fusion import FusionConfig, Observations, forest, fuse, turned
from canopy_skel.geometry import transform_points
from canopy_skel.kernels import profile
from canopy_skel.observe import observe
from canopy_skel.pieces import PieceConfig, pieces_of, regions_of_masks
from canopy_skel.pipeline import MethodConfig, Skeletonizer, models_for
from canopy_skel.recording import read_recording
from canopy_skel.segmenters.mapping import MappingSegmenter
from canopy_skel.segmenters.recorded import RecordedSegmenter
from canopy_skel.segmenters.unet.portable import PortableNetwork
from canopy_skel.wood import FragmentConfig, fragments_of, wood_probability
from canopy_skel.woodpixels import shipped_pixel_model

PLAIN = view_from(0)
DEMO = Path(__file__).parents[2] / "recordings/demo_apple.mcap"


@pytest.fixture(scope="module")
def views():
    return [leafy_view(0), leafy_view(1, y=0.1), leafy_view(2, z=0.1)]


@pytest.fixture(scope="module")
def clear_views():
    return [PLAIN, view_from(1, y=0.1), view_from(2, z=0.1)]


def maker_of(views, **settings_):
    config = MethodConfig(name="canopy", canopy=CanopyConfig(**settings_))
    maker = Skeletonizer(RecordedSegmenter(), config)
    for view in views:
        maker.add_view(view)
    return maker


def document_of(maker):
    used = len(maker.views)
    return build_document(
        maker.skeleton().graph,
        scan_id="s",
        revision=used,
        method=Method(name="canopy"),
        views_used=used,
    )


def off_wood(points):
    off = []
    for start, end, _ in WOOD:
        start, way = np.array(start), np.array(end) - np.array(start)
        along = np.clip((points - start) @ way / (way @ way), 0, 1)
        off.append(np.linalg.norm(points - start - along[:, None] * way, axis=1))
    return np.min(off, axis=0)


def test_the_skeleton_lies_in_the_wood_and_a_link_bridges_what_leaves_hide(views):
    document = document_of(maker_of(views))
    source = np.array(document.extra["source"])
    assert off_wood(document.position)[source == "observed"].max() < 0.006
    linked = document.position[source == "link"]
    assert np.linalg.norm(linked - GAP, axis=1).min() < 0.01
    np.testing.assert_array_equal(document.occluded, np.isin(source, ["link", "extension"]))
    assert (document.confidence[~document.occluded] > 0.5).all()


def test_nothing_is_predicted_where_the_sky_shows_through(clear_views):
    document = document_of(maker_of(clear_views))
    ahead = document.position[document.occluded]
    assert (np.linalg.norm(ahead - GAP, axis=1) > 0.02).all()
    assert off_wood(ahead).max(initial=0.0) < 0.02


def test_radii_are_those_of_the_sticks(views):
    document = document_of(maker_of(views))
    trunk = ~document.occluded & (np.abs(document.position[:, 1]) < 0.005)
    assert np.median(document.radius[trunk]) == pytest.approx(0.015, rel=0.15)


def test_wood_lies_along_wood_in_view_after_view_and_beside_it_crosswise():
    scan = CanopyScan(CanopyConfig())
    segmenter = RecordedSegmenter()
    one, other = (scan.observe(v, segmenter.segment(v)) for v in (PLAIN, view_from(1, y=0.1)))
    points, way = one.points_in_base, one.directions
    seen = other.agreement(points, way)
    assert seen[:, 0].mean() > 0.95
    np.testing.assert_array_equal(seen[:, 1], seen[:, 0])
    assert not seen[:, 2].any()
    across = np.linalg.svd(way[:, None, :])[2][:, 2]
    turned = other.agreement(points, across)
    assert turned[:, 0].mean() > 0.95
    assert turned[:, 1].mean() < 0.2
    assert not other.agreement(points + 0.5, way).any()


def test_the_order_of_views_and_asking_in_between_do_not_matter_to_the_byte(views):
    expected = to_json(document_of(maker_of(views)))
    for order in permutations(views):
        maker = maker_of([])
        for view in order:
            maker.add_view(view)
            maker.skeleton()
            maker.add_view(view)
        assert to_json(document_of(maker)) == expected


def test_a_view_taken_off_leaves_no_trace(views):
    maker = maker_of(views)
    maker.remove_view(1)
    assert to_json(document_of(maker)) == to_json(document_of(maker_of([views[0], views[2]])))


def test_rooted_gives_one_tree_whose_extra_joins_nobody_will_believe(clear_views):
    apart, rooted = (document_of(maker_of(clear_views, rooted=r)) for r in (False, True))
    assert apart.components > 1
    assert rooted.components == 1
    assert rooted.confidence[rooted.occluded].min() <= 0.1
    assert len(rooted.edges) == len(rooted.position) - 1


def test_a_view_whose_pose_is_off_is_moved_back_and_the_others_are_not():
    good = [
        view_from(i, y=y, z=z)
        for i, (y, z) in enumerate([(0, 0), (0.08, 0), (-0.08, 0.05), (0, 0.1)])
    ]
    last = view_from(4, y=0.04)
    pose = last.base_from_camera.copy()
    pose[1, 3] += 0.007
    extraction = maker_of([*good, replace(last, base_from_camera=pose)]).skeleton()
    (correction,) = extraction.corrections
    assert correction.view == 4
    assert correction.after_m < 0.5 * correction.before_m
    assert correction.moved[1, 3] + correction.moved[1, :3] @ [1, 0, 0] == pytest.approx(
        -0.007, abs=0.003
    )
    assert maker_of([*good, last]).skeleton().corrections == ()


def test_documents_keep_how_each_vertex_is_known(views):
    document = document_of(maker_of(views))
    assert from_json(to_json(document)).extra["source"] == document.extra["source"]


def test_views_without_wood_give_an_empty_skeleton():
    maker = maker_of([replace(PLAIN, instances=np.zeros((240, 320), np.uint16))])
    extraction = maker.skeleton()
    assert len(extraction.graph.vertices_in_base) == 0
    assert extraction.voxels == 0


def test_other_methods_do_not_notice_the_settings_of_canopy():
    paper = MethodConfig(name="paper")
    assert replace(paper, canopy=CanopyConfig(rooted=True)).sha256() == paper.sha256()
    rooted = MethodConfig(name="canopy", canopy=CanopyConfig(rooted=True))
    assert rooted.sha256() != MethodConfig(name="canopy").sha256()


def test_settings_survive_being_taken_apart():
    config = CanopyConfig(rooted=True, fragments=FragmentConfig(min_px=12))
    assert canopy_config_from(asdict(config)) == config


@pytest.mark.parametrize("wrong", [{"fragment_knots": n} for n in (-1, 1, 9)] + [{"knot_px": 0}])
def test_pieces_of_more_knots_than_there_is_room_for_are_refused(wrong):
    assert PieceConfig(fragment_knots=profile.MAX_KNOTS).fragment_knots == 8
    with pytest.raises(UsageError, match="give 2 to 8"):
        PieceConfig(**wrong)


def test_pieces_run_along_the_axes_of_the_sticks():
    view = PLAIN
    regions = regions_of_masks(RecordedSegmenter().segment(view))
    pieces = pieces_of(view, regions, PieceConfig(), fragments=False)
    assert len(pieces) == 3
    for piece, (start, end, radius) in zip(pieces, WOOD, strict=True):
        knots = piece.spline.control_points_in_base
        assert off_wood(knots).max() < 0.005
        length = np.linalg.norm(knots[-1] - knots[0])
        assert length == pytest.approx(np.linalg.norm(np.subtract(end, start)), abs=0.012)
        assert piece.spline.radius_m == pytest.approx(radius, rel=0.25)


def test_what_a_network_says_of_the_radius_counts_for_more_the_thinner_the_wood():
    thin, *_, thick = sorted(RecordedSegmenter().segment(PLAIN), key=lambda mask: mask.mask.sum())

    def radii(mask):
        regions = regions_of_masks([mask])
        (piece,) = pieces_of(PLAIN, regions, PieceConfig(), fragments=False)
        return piece.radius_m, piece.spline.radius_m, piece.pixel_m

    shares = []
    for mask in (thin, thick):
        probable_m, measured_m, pixel_m = radii(mask)
        assert probable_m == measured_m
        half_m, still_measured_m, _ = radii(replace(mask, radius_px=0.5 * measured_m / pixel_m))
        assert still_measured_m == measured_m
        assert 0.5 * measured_m < half_m < measured_m
        shares.append(np.log(half_m / measured_m) / np.log(0.5))
    assert shares[0] > 0.7
    assert shares[1] < shares[0]


def test_fragments_are_as_thick_as_the_network_says():
    probability = np.zeros((240, 320), np.float32)
    probability[100:104, 60:100] = 0.9
    maps = np.zeros((5, 60, 80), np.float32)
    maps[4] = np.log(3.0)  # of a picture enlarged so that a cell, four pixels here, is two there
    regions = fragments_of(probability, maps, FragmentConfig())
    view = replace(PLAIN, depth_m=np.ones((240, 320), dtype=np.float32))
    (piece,) = pieces_of(view, regions, PieceConfig(), fragments=True)
    assert piece.radius_m == pytest.approx(6.0 / PLAIN.intrinsics.fx_px, rel=1e-3)
    assert piece.spline.radius_m == pytest.approx(2.0 / PLAIN.intrinsics.fx_px, rel=0.1)


def test_a_wall_is_no_branch():
    wall = np.zeros((240, 320), np.uint16)
    wall[60:180, 20:300] = 1
    view = replace(
        PLAIN, instances=wall, scores=(0.9,), depth_m=np.ones((240, 320), dtype=np.float32)
    )
    regions = regions_of_masks(RecordedSegmenter().segment(view))
    assert pieces_of(view, regions, PieceConfig(), fragments=False) == []
    thicker = PieceConfig(thickest_m=0.5)
    assert len(pieces_of(view, regions, thicker, fragments=False)) == 1


@pytest.mark.parametrize("metres", [15.0, 30.0, 59.0])
def test_wood_counts_as_far_away_as_the_settings_say(metres):
    pole = np.zeros((240, 320), np.uint16)
    pole[100:104, 20:300] = 1
    view = replace(
        PLAIN,
        intrinsics=replace(PLAIN.intrinsics, fx_px=2000, fy_px=2000),
        instances=pole,
        scores=(0.9,),
        depth_m=np.full((240, 320), metres, dtype=np.float32),
    )
    regions = regions_of_masks(RecordedSegmenter().segment(view))
    (piece,) = pieces_of(view, regions, PieceConfig(farthest_m=60.0), fragments=False)
    distances = np.linalg.norm(piece.spline.control_points_in_base, axis=1)
    assert distances == pytest.approx(metres, rel=0.02)


@pytest.mark.parametrize("degrees", [0, 35, 90, 160])
def test_a_small_fragment_runs_as_the_network_says_and_a_long_one_as_its_pixels_do(degrees):
    angle = np.radians(degrees)
    probability = np.zeros((240, 320), np.float32)
    probability[100:104, 60:64] = 0.9
    probability[150:154, 100:300] = 0.9
    maps = np.zeros((5, 60, 80), np.float32)
    maps[2], maps[3] = np.cos(2 * angle), np.sin(2 * angle)
    regions = fragments_of(probability, maps, FragmentConfig())
    view = replace(PLAIN, depth_m=np.ones((240, 320), dtype=np.float32))
    for piece, expected in zip(
        pieces_of(view, regions, PieceConfig(), fragments=True), (angle, 0.0), strict=True
    ):
        knots = piece.spline.control_points_in_base
        # The camera looks along x: u is -y of base, v is -z.
        way = (knots[0] - knots[-1])[1:]
        turn = np.arctan2(way[1], way[0]) - expected
        assert abs(np.degrees(np.arcsin(np.sin(turn)))) < 6


def test_a_mask_without_pixels_is_dropped_and_the_others_are_not():
    masks = list(RecordedSegmenter().segment(PLAIN))
    hollow = replace(masks[0], instance=99, mask=np.zeros((4, 9), np.bool_))
    seen = observe(PLAIN, [hollow, *masks], PieceConfig(), FragmentConfig())
    assert (len(seen.splines), seen.dropped) == (len(masks), (99,))


def test_wood_of_the_next_row_is_not_of_this_tree():
    behind = PLAIN.instances == 3
    view = replace(PLAIN, depth_m=np.where(behind, np.float32(4.2), PLAIN.depth_m))
    masks = RecordedSegmenter().segment(view)
    seen = observe(view, list(masks), PieceConfig(), FragmentConfig())
    assert (len(seen.splines), seen.dropped) == (2, (3,))
    assert off_wood(seen.points_in_base).max() < 0.03
    there = transform_points(
        view.base_from_camera, back_projected(view, behind & np.isfinite(view.depth_m))
    )
    assert not count_evidence(there, [seen.evidence])[:, WOOD_SEEN].any()
    wider = observe(view, list(masks), PieceConfig(farthest_m=5.0), FragmentConfig())
    assert len(wider.splines) == 3


def back_projected(view, chosen):
    v, u = np.nonzero(chosen)
    return view.intrinsics.back_project(
        u.astype(np.float64), v.astype(np.float64), view.depth_m[v, u].astype(np.float64)
    )


def test_leaves_that_cover_some_pixels_do_not_move_a_piece():
    view = PLAIN
    depth_m = view.depth_m.copy()
    rows, columns = np.nonzero(view.instances == 1)
    hit = np.random.default_rng(1).random(len(rows)) < 0.4
    depth_m[rows[hit], columns[hit]] = 0.8
    spoilt = replace(PLAIN, depth_m=depth_m)
    regions = regions_of_masks(RecordedSegmenter().segment(spoilt))
    trunk = pieces_of(spoilt, regions, PieceConfig(), fragments=False)[0]
    assert off_wood(trunk.spline.control_points_in_base).max() < 0.006


@settings(deadline=None, max_examples=50)
@given(
    stick=st.integers(0, 2),
    along=st.floats(0.05, 0.95),
    fraction=st.floats(0.3, 0.9),
    beyond=st.floats(0.1, 0.5),
)
def test_a_view_sees_through_what_is_before_wood_and_never_through_wood(
    stick, along, fraction, beyond
):
    evidence = evidence_of(PLAIN, PLAIN.instances > 0)
    start, end, _ = WOOD[stick]
    wood = np.array(start) + along * np.subtract(end, start)
    counts = count_evidence(
        np.array([wood, wood * fraction, wood * (1 + beyond)]), [evidence, evidence]
    )
    assert not is_empty(counts)[0]
    assert counts[0, WOOD_SEEN] == 2
    assert counts[1, WOOD_SEEN] == 0
    assert counts[2, HIDDEN] == 2


def test_unmasked_wood_is_told_from_leaves():
    view = next(iter(read_recording(DEMO).views()))
    left_out = (view.instances > 0) & (view.instances % 3 == 0)
    masked = (view.instances > 0) & ~left_out
    config = FragmentConfig()
    maps = PortableNetwork().maps(view.color_rgb)
    probability = wood_probability(view, maps, masked, config, shipped_pixel_model())
    found = fragments_of(probability, maps, config)
    shown = np.zeros(masked.shape, bool)
    shown[found.v, found.u] = True
    assert shown[left_out].mean() > 0.6
    assert shown[view.instances == 0].mean() < 0.02  # small wood without a mask among it
    assert not shown[masked].any()


def test_fragments_turn_along_what_lies_around_them_and_instances_do_not():
    random = np.random.default_rng(3)
    way = np.array([2.0, 1.0, 2.0]) / 3
    points = np.linspace(0, 0.2, 41)[:, None] * way + random.normal(0, 0.001, (41, 3))
    directions = random.normal(size=(41, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    seen = Observations(
        points_in_base=points,
        directions=directions,
        radius_m=np.full(41, 0.004),
        probable_radius_m=np.full(41, 0.004),
        probability=np.full(41, 0.8),
        view=np.zeros(41, np.int64),
        fragment=np.arange(41) > 0,
    )
    found = turned(seen, FusionConfig()).directions
    assert np.abs(found[1:] @ way).min() > 0.95
    assert np.array_equal(found[0], directions[0])


@given(st.floats(30, 60), st.floats(0.0, 0.006))
def test_a_side_branch_meets_its_parent_in_its_own_direction(angle_deg, shift_m):
    trunk = np.column_stack([np.arange(-0.06, 0.06, 0.006), np.zeros((20, 2))])
    way = np.array([np.cos(np.radians(angle_deg)), np.sin(np.radians(angle_deg)), 0.0])
    away_m = 0.008 / way[1] + 0.006 * np.arange(8)
    branch = [shift_m, 0.0, 0.0] + away_m[:, None] * way
    points = np.concatenate([trunk, branch])
    directions = np.concatenate([np.tile([1.0, 0, 0], (20, 1)), np.tile(way, (8, 1))])
    edges = forest(points, directions, 0.017)
    assert len(edges) == len(points) - 1
    [fork] = edges[(edges.min(axis=1) < 20) & (edges.max(axis=1) >= 20)]
    first = points[fork.max()] - points[fork.min()]
    assert first @ way / np.linalg.norm(first) > np.cos(np.radians(40))


@pytest.mark.parametrize("fragments", [True, False])
def test_what_fragments_show_runs_as_they_point_tips_included(fragments):
    x = np.arange(0.0, 0.06, 0.0061)
    off_m = 0.002 * (-1.0) ** np.arange(len(x))
    seen = Observations(
        points_in_base=np.column_stack([x, off_m, np.zeros(len(x))]),
        directions=np.tile([1.0, 0.0, 0.0], (len(x), 1)),
        radius_m=np.full(len(x), 0.002),
        probable_radius_m=np.full(len(x), 0.002),
        probability=np.full(len(x), 0.8),
        view=np.zeros(len(x), np.int64),
        fragment=np.full(len(x), fragments),
    )
    config = FusionConfig(steps=0, bandwidth_m=0.001, own_direction=1e6)
    found = fuse(seen, config)
    way = np.diff(found.vertices_in_base[found.edges], axis=1)[:, 0]
    along = np.abs(way[:, 0]) / np.linalg.norm(way, axis=1)
    assert len(way) == len(x) - 1
    assert (along.min() > 0.9) == fragments


def test_a_segmenter_with_maps_of_its_own_is_asked_for_them_and_only_for_fragments():
    asked = []

    class Network(RecordedSegmenter):
        def segment_and_map(self, view):
            asked.append(view.index)
            return self.segment(view), np.zeros((5, 12, 16), np.float32)

    assert isinstance(Network(), MappingSegmenter)
    assert not isinstance(RecordedSegmenter(), MappingSegmenter)
    for use_fragments in (True, False):
        config = MethodConfig(name="canopy", canopy=CanopyConfig(use_fragments=use_fragments))
        Skeletonizer(Network(), config).add_view(PLAIN)
        assert asked == [PLAIN.index]


def test_what_one_view_shows_is_believed_less_where_a_network_found_it(views):
    class Network:
        def segment(self, view):
            return RecordedSegmenter().segment(view)

    assert models_for(RecordedSegmenter()) == shipped_models()["recorded"]
    assert models_for(Network()) == shipped_models()["learned"]
    config = MethodConfig(name="canopy")
    trusting, wary = Skeletonizer(RecordedSegmenter(), config), Skeletonizer(Network(), config)
    for maker in (trusting, wary):
        maker.add_view(views[0])
    doubt = [1 - maker.skeleton().graph.confidence.mean() for maker in (trusting, wary)]
    assert doubt[1] > doubt[0]


def test_matched_depth_has_models_of_its_own_whatever_the_order(views):
    def confidence(views, models=None):
        maker = Skeletonizer(RecordedSegmenter(), MethodConfig(name="canopy"), models=models)
        for view in views:
            maker.add_view(view)
        return maker.skeleton().graph.confidence.tobytes()

    shipped = models_for(RecordedSegmenter())
    assert shipped["stereo"] != shipped["camera"]
    matched = [replace(views[0], matched=True), *views[1:]]
    as_stereo = confidence(views, {"camera": shipped["stereo"], "stereo": shipped["stereo"]})
    assert confidence(matched) == confidence(matched[::-1]) == as_stereo
    assert confidence(views) != as_stereo


def test_a_false_mask_is_false_as_a_whole():
    means = piece_means(np.array([[0.0, 1.0], [2.0, 1.0], [7.0, 3.0]]), np.array([0, 0, 1]))
    assert means.tolist() == [[1.0, 1.0], [1.0, 1.0], [7.0, 3.0]]
