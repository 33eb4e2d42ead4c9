"""Views whose poses are centimetres off: brought back if they fit anywhere, and always named."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from canopy_skel.document import from_json, to_json
from canopy_skel.metrics import score
from canopy_skel.pipeline import MethodConfig, Skeletonizer
from canopy_skel.recording import RecordingWriter, read_recording
from canopy_skel.segmenters.recorded import RecordedSegmenter
from service.replay import ReplayRequest, replay
from service.skeletons import document_of

DEMO = Path(__file__).parents[2] / "recordings/demo_apple.mcap"
OFF = 3


@pytest.fixture(scope="module")
def views():
    return list(read_recording(DEMO).views())


def shifted(view, by_m, turned_deg=0.0):
    base_from_camera = np.array(view.base_from_camera)
    base_from_camera[:3, :3] @= Rotation.from_euler("y", turned_deg, degrees=True).as_matrix()
    base_from_camera[:3, 3] += by_m
    return replace(view, base_from_camera=base_from_camera)


def mirrored(view):
    """Return a view of a tree that is nowhere near: upside down and the wrong way round."""
    return replace(
        view,
        color_rgb=view.color_rgb[::-1, ::-1].copy(),
        depth_m=view.depth_m[::-1, ::-1].copy(),
        instances=view.instances[::-1, ::-1].copy(),
    )


def with_one(views, change):
    return [change(view) if view.index == OFF else view for view in views]


def skeleton_of(views):
    maker = Skeletonizer(RecordedSegmenter(), MethodConfig(name="canopy"))
    for view in views:
        maker.add_view(view)
    return document_of(maker, maker.skeleton(), scan_id="off", rejected=())


def replayed(views, tmp_path):
    path = tmp_path / "moved.mcap"
    with RecordingWriter(path, {"scan_id": "moved"}) as writer:
        for view in views:
            writer.write_view(view)
    request = ReplayRequest(
        config=MethodConfig(name="canopy"),
        segmenter="recorded",
        formats=("json",),
        topics=None,
        memory_limit_bytes=1 << 32,
    )
    return replay(path, tmp_path, request, lambda done, total: None)


def test_good_views_are_where_they_say(views):
    document = skeleton_of(views)
    assert document.views_moved == ()
    assert document.views_alone == ()


@pytest.mark.parametrize(
    ("by_m", "turned_deg"), [([0, 0.04, 0], 0), ([0.05, -0.04, 0.05], 0), ([0, 0.03, -0.02], 3)]
)
def test_a_view_that_is_centimetres_off_is_taken_to_where_it_fits(views, by_m, turned_deg):
    truth = from_json(read_recording(DEMO).ground_truth)
    good = score(skeleton_of(views), truth)
    document = skeleton_of(with_one(views, lambda view: shifted(view, by_m, turned_deg)))
    [moved] = document.views_moved
    assert moved.index == OFF
    assert moved.by_m == pytest.approx(np.linalg.norm(by_m), abs=0.002 + 0.02 * turned_deg)
    assert document.views_alone == ()
    mended = score(document, truth)
    assert mended.precision > good.precision - 0.005
    assert mended.recall > good.recall - 0.005


def test_half_of_the_views_may_be_off(views):
    random = np.random.default_rng(1)
    some = [shifted(v, random.uniform(-0.05, 0.05, 3)) if v.index % 2 else v for v in views]
    document = skeleton_of(some)
    assert {one.index for one in document.views_moved} == {v.index for v in views if v.index % 2}


def test_a_view_with_little_wood_is_not_moved_for_it_fits_in_many_places(views):
    def sparse(view):
        largest = np.argsort(np.bincount(view.instances.ravel())[1:])[-2:] + 1
        instances = np.where(np.isin(view.instances, largest), view.instances, 0)
        return shifted(replace(view, instances=instances.astype(np.uint16)), [0, 0.05, 0])

    document = skeleton_of(with_one(views, sparse))
    assert document.views_moved == ()
    assert document.views_alone == (OFF,)


@pytest.mark.parametrize("apart_m", [0.3, 0.5])
def test_views_that_have_nothing_in_common_are_not_moved(views, apart_m):
    ways = apart_m * np.array([[0, 0, 0], [0, 1, 0], [0, 0, 1], [0, 1, 1]])
    document = skeleton_of([shifted(v, way) for v, way in zip(views, ways, strict=True)])
    assert document.views_moved == ()


def test_half_of_a_view_beside_what_the_others_show_stays_where_it_is(views):
    middle = views[0].instances.shape[1] // 2

    def left(view):
        instances = view.instances.copy()
        instances[:, middle + 60 :] = 0
        return replace(view, instances=instances)

    def right(view):
        instances = view.instances.copy()
        instances[:, : middle - 60] = 0
        return replace(view, instances=instances)

    some = [left(view) if view.index == OFF else right(view) for view in views]
    assert skeleton_of(some).views_moved == ()


def test_where_views_are_off_their_order_still_does_not_matter(views):
    some = with_one(views, lambda view: shifted(view, [0, 0.04, 0]))
    assert to_json(skeleton_of(some)) == to_json(skeleton_of(some[::-1]))


def test_a_document_says_which_views_were_moved_or_stand_alone(views):
    moved = skeleton_of(with_one(views, lambda view: shifted(view, [0, 0.04, 0])))
    assert from_json(to_json(moved)).views_moved == tuple(
        replace(one, by_m=round(one.by_m, 5)) for one in moved.views_moved
    )
    alone = skeleton_of(with_one(views, mirrored))
    assert alone.views_moved == ()
    assert alone.views_alone == (OFF,)
    assert from_json(to_json(alone)).views_alone == (OFF,)


def test_a_replay_names_a_view_it_moved(views, tmp_path):
    [warning] = replayed(
        with_one(views, lambda view: shifted(view, [0, 0.04, 0])), tmp_path
    ).warnings
    assert "view 3" in warning
    assert "4 cm off" in warning
    [pose] = json.loads((tmp_path / "moved.summary.json").read_text())["poses"]
    assert pose["view"] == OFF
    assert pose["moved_mm"] == pytest.approx(40, abs=2)
    assert pose["after_mm"] < 4


def test_a_replay_names_a_view_that_fits_nowhere(views, tmp_path):
    [warning] = replayed(with_one(views, mirrored), tmp_path).warnings
    assert "view 3" in warning
    assert "another tree" in warning
