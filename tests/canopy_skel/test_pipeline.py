import numpy as np
import pytest
from scenes.leaves import leafy_view
from scenes.wood import WOOD, view_from

from canopy_skel.canopy import CanopyConfig
from canopy_skel.cluster import ClusterConfig
from canopy_skel.document import Method, build_document, to_json
from canopy_skel.errors import UsageError, ViewError
from canopy_skel.extend import ExtensionConfig
from canopy_skel.frame import View
from canopy_skel.graph import SOURCES
from canopy_skel.initial import InitialConfig
from canopy_skel.likelihood import LikelihoodConfig
from canopy_skel.pieces import PieceConfig
from canopy_skel.pipeline import JOINERS, METHODS, MethodConfig, Skeletonizer
from canopy_skel.recording import read_recording
from canopy_skel.segment import BranchMask
from canopy_skel.segmenters.recorded import RecordedSegmenter
from canopy_skel.spline import SplineConfig
from drivers.stereo import with_depth


@pytest.fixture(scope="module")
def views():
    return [view_from(0), view_from(1, y=0.1), view_from(2, z=0.1)]


def skeletonizer(name="paper", voxel=0.005, **kwargs):
    config = MethodConfig(name=name, likelihood=LikelihoodConfig(voxel_size_m=voxel))
    return Skeletonizer(RecordedSegmenter(), config, **kwargs)


def bytes_of(maker):
    graph = maker.skeleton().graph
    method = Method(name="paper")
    used = len(maker.views)
    return to_json(
        build_document(graph, scan_id="s", revision=used, method=method, views_used=used)
    )


def to_segment(points, start, end):
    start, end = np.array(start), np.array(end)
    along = np.clip((points - start) @ (end - start) / ((end - start) @ (end - start)), 0, 1)
    return np.linalg.norm(points - start - along[:, None] * (end - start), axis=1)


def test_the_skeleton_lies_in_the_wood_and_bridges_the_gap(views):
    maker = skeletonizer()
    assert [maker.add_view(view) for view in views] == [3, 3, 3]
    extraction = maker.skeleton()
    graph = extraction.graph
    off = np.min([to_segment(graph.vertices_in_base, s, e) for s, e, _ in WOOD], axis=0)
    assert off[~graph.occluded].max() < 0.012
    assert graph.components()[0] == 1
    assert len(extraction.joins) == extraction.observed_components - 1
    bridged = graph.vertices_in_base[graph.occluded]
    assert to_segment(bridged, (1.0, 0.0, 0.0), (1.0, 0.3, 0.14)).max() < 0.02
    assert ((bridged[:, 1] > 0.19) & (bridged[:, 1] < 0.23)).any()


def test_the_order_of_views_does_not_matter_to_the_byte(views):
    one, other = skeletonizer(), skeletonizer()
    for view in views:
        one.add_view(view)
    for view in reversed(views):
        other.add_view(view)
    assert bytes_of(one) == bytes_of(other)


def test_asking_in_between_and_adding_twice_changes_nothing(views):
    one, other = skeletonizer(), skeletonizer()
    for view in views:
        one.add_view(view)
        one.skeleton()
        one.add_view(view)
        other.add_view(view)
    assert one.views == (0, 1, 2)
    assert bytes_of(one) == bytes_of(other)


def test_moving_the_camera_rig_by_whole_voxels_moves_the_skeleton(views):
    shift = np.array([8, -24, 16]) * 0.0078125
    here, there = skeletonizer(voxel=0.0078125), skeletonizer(voxel=0.0078125)
    for view in views:
        moved = view.base_from_camera.copy()
        moved[:3, 3] += shift
        here.add_view(view)
        there.add_view(
            View(
                **{name: getattr(view, name) for name in View.__slots__}
                | {"base_from_camera": moved}
            )
        )
    one, other = here.skeleton().graph, there.skeleton().graph
    np.testing.assert_allclose(other.vertices_in_base, one.vertices_in_base + shift, atol=1e-6)
    np.testing.assert_array_equal(one.edges, other.edges)


def test_after_every_view_the_skeleton_is_that_of_a_start_from_scratch(views):
    maker = skeletonizer()
    for count, view in enumerate(views, start=1):
        maker.add_view(view)
        maker.preview()
        scratch = skeletonizer()
        for known in reversed(views[:count]):
            scratch.add_view(known)
        assert bytes_of(maker) == bytes_of(scratch)


@pytest.mark.parametrize("name", ["oak_fd3", "apple_dense"])
def test_after_every_view_of_a_recording_too(shared_recording, name):
    views = [with_depth(view) for view in read_recording(shared_recording(name)).views()]
    order = np.random.default_rng(len(name)).permutation(len(views))
    maker, known = skeletonizer(voxel=0.01), []
    for i in order:
        maker.add_view(views[i])
        known.append(views[i])
        scratch = skeletonizer(voxel=0.01)
        for view in known:
            scratch.add_view(view)
        assert bytes_of(maker) == bytes_of(scratch)
    for i in order[:-2]:
        maker.skeleton()
        maker.remove_view(i)
    scratch = skeletonizer(voxel=0.01)
    for i in order[-2:]:
        scratch.add_view(views[i])
    assert bytes_of(maker) == bytes_of(scratch)


@pytest.mark.parametrize("name", METHODS)
def test_a_view_that_is_removed_was_never_there(views, name):
    maker, other = skeletonizer(name), skeletonizer(name)
    for view in views:
        maker.add_view(view)
    maker.skeleton()
    maker.remove_view(1)
    other.add_view(views[2])
    other.add_view(views[0])
    assert maker.views == (0, 2)
    assert maker.instances == other.instances
    assert bytes_of(maker) == bytes_of(other)
    maker.add_view(views[1])
    other.add_view(views[1])
    assert bytes_of(maker) == bytes_of(other)
    for index in (0, 1, 2):
        maker.remove_view(index)
    assert maker.skeleton().voxels == 0
    with pytest.raises(UsageError, match="view 1 is not in"):
        maker.remove_view(1)


def test_views_can_be_removed_where_sums_have_hit_their_limit(views):
    maker, other = skeletonizer(), skeletonizer()
    for view in views[:2]:
        maker.add_view(view)
    sums = maker._map._sums
    sums[np.argmax(sums)] = 1 << 30
    maker.remove_view(0)
    other.add_view(views[1])
    assert bytes_of(maker) == bytes_of(other)


def test_a_preview_says_so_and_is_a_forest_with_as_many_pieces(views):
    maker = skeletonizer()
    for view in views:
        maker.add_view(view)
    preview, exact = maker.preview(), maker.skeleton()
    assert preview.preview
    assert not exact.preview
    assert preview.graph.components()[0] == exact.graph.components()[0]
    count = preview.graph.components()[0]
    assert len(preview.graph.edges) == len(preview.graph.vertices_in_base) - count
    assert len(preview.joins) == len(exact.joins)


@pytest.mark.parametrize("name", METHODS)
def test_every_method_gives_a_forest(views, name):
    # Method canopy sees the sky through an open gap, and leaves it open.
    leafy = [leafy_view(0), leafy_view(1, y=0.1), leafy_view(2, z=0.1)]
    maker = skeletonizer(name)
    for view in leafy if name == "canopy" else views:
        maker.add_view(view)
    graph = maker.skeleton().graph
    count, _ = graph.components()
    assert len(graph.edges) == len(graph.vertices_in_base) - count > 50
    assert graph.occluded.any()


def test_views_without_wood_give_an_empty_skeleton():
    maker = skeletonizer()
    maker.add_view(view_from(0, instances=np.zeros((240, 320), np.uint16)))
    extraction = maker.skeleton()
    assert len(extraction.graph.vertices_in_base) == 0
    assert extraction.voxels == 0


def test_a_view_that_cannot_be_used_costs_the_others_nothing(views):
    maker, alone = skeletonizer(), skeletonizer()
    maker.add_view(views[0])
    alone.add_view(views[0])
    with pytest.raises(ViewError, match=r"view 1: /camera/branches/instances holds instance 3"):
        maker.add_view(view_from(1, scores=(0.9,)))
    assert maker.views == (0,)
    assert bytes_of(maker) == bytes_of(alone)


def test_a_view_from_far_away_is_refused_before_it_stretches_the_map(views):
    maker = skeletonizer()
    maker.add_view(views[0])
    far = np.array(views[1].base_from_camera)
    far[:3, 3] *= 1000
    far[0, 3] += 100
    with pytest.raises(ViewError, match=r"view 1: its camera is at .* check its pose on /tf"):
        maker.add_view(view_from(1, base_from_camera=far))
    assert maker.views == (0,)


class Fixed:
    """A segmenter that finds one branch, the same in every view."""

    def __init__(self, **wrong):
        mask = {"left_px": 5, "top_px": 5, "mask": np.ones((4, 30), np.bool_), "confidence": 0.9}
        self.masks = [BranchMask(instance=7, **(mask | wrong))]

    def segment(self, view):
        return self.masks


@pytest.mark.parametrize("name", METHODS)
@pytest.mark.parametrize(
    ("wrong", "says"),
    [
        ({"left_px": 300}, "covers columns 300 to 330"),
        ({"top_px": 237}, "rows 237 to 241 of a picture of 320x240"),
        ({"left_px": -1}, "covers columns -1 to 29"),
        ({"mask": np.ones((4, 30), np.uint8)}, "is 2-D uint8"),
        ({"mask": np.ones(30, np.bool_)}, "is 1-D bool"),
        ({"confidence": np.nan}, "has a confidence of nan"),
        ({"confidence": 1.5}, "has a confidence of 1.5"),
        ({"confidence": -0.1}, "has a confidence of -0.1"),
    ],
)
def test_a_mask_that_cannot_be_costs_the_view(views, wrong, says, name):
    maker = Skeletonizer(Fixed(**wrong), MethodConfig(name=name))
    with pytest.raises(ViewError, match=f"view 0: the mask of instance 7 .*{says}"):
        maker.add_view(views[0])
    assert maker.views == ()


def test_a_mask_without_confidence_counts_for_nothing(views):
    maker = skeletonizer()
    assert maker.add_view(view_from(0, scores=(0.9, 0.0, 0.9))) == 2


@pytest.mark.parametrize(
    ("config", "wrong"),
    [
        (ExtensionConfig, {"step_m": 0.0}),
        (ExtensionConfig, {"reach_m": -0.1}),
        (ExtensionConfig, {"reach_m": np.inf}),
        (SplineConfig, {"control_points": 1}),
        (SplineConfig, {"control_points": 0}),
        (LikelihoodConfig, {"k": np.nan}),
        (LikelihoodConfig, {"k": 0.0}),
        (LikelihoodConfig, {"k": -1.0}),
        (LikelihoodConfig, {"max_confidence": 1.0}),
        (PieceConfig, {"tolerance_m": 0.0}),
        (ClusterConfig, {"tolerance_m": np.nan}),
        (ClusterConfig, {"connect_m": 0.0}),
        (InitialConfig, {"bandwidth_m": 0.0}),
    ],
)
def test_a_setting_that_cannot_be_is_named_with_its_value(config, wrong):
    ((name, value),) = wrong.items()
    with pytest.raises(UsageError, match=rf"{name} {value}\b.*: .*(give|at least)"):
        config(**wrong)


def test_a_reach_of_less_than_a_step_means_no_extensions():
    def extended(reach_m):
        extensions = ExtensionConfig(reach_m=reach_m, min_probability=0.0)
        maker = Skeletonizer(
            RecordedSegmenter(), MethodConfig(canopy=CanopyConfig(extensions=extensions))
        )
        maker.add_view(leafy_view(0))
        return np.count_nonzero(maker.skeleton().graph.source == SOURCES.index("extension"))

    assert extended(0.1) > 0
    assert extended(0.0) == extended(0.002) == 0


def test_an_unknown_method_names_the_known_ones():
    with pytest.raises(
        UsageError, match="unknown method 'best': choose one of canopy, paper, mst, ftsem"
    ):
        MethodConfig(name="best")


def test_the_configuration_hash_names_the_settings():
    assert MethodConfig().sha256() == MethodConfig().sha256()
    other = MethodConfig(likelihood=LikelihoodConfig(voxel_size_m=0.01))
    assert MethodConfig().sha256() != other.sha256()


@pytest.mark.parametrize("first", sorted(JOINERS))
def test_methods_that_share_their_front_end_are_as_each_alone(views, first):
    shared = skeletonizer(first)
    for view in views:
        shared.add_view(view)
    for name in (first, *sorted(JOINERS)):
        alone = skeletonizer(name)
        for view in views:
            alone.add_view(view)
        graph, other = alone.skeleton().graph, shared.skeleton(joined_by=name).graph
        np.testing.assert_array_equal(graph.vertices_in_base, other.vertices_in_base)
        np.testing.assert_array_equal(graph.edges, other.edges)
        np.testing.assert_array_equal(graph.confidence, other.confidence)
