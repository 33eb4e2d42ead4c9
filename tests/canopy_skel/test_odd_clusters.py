"""Masks that touch, repeat, lie in one line, or fill the picture: still a forest in the wood."""

import numpy as np
import pytest
from scipy.spatial import cKDTree

from canopy_skel.frame import Intrinsics, View
from canopy_skel.pipeline import JOINERS, METHODS, MethodConfig, Skeletonizer
from canopy_skel.segmenters.recorded import RecordedSegmenter

SMALL, LARGE = (240, 320), (1080, 1440)
SCENES = {
    "none": (SMALL, []),
    "one": (SMALL, [(110, 118, 40, 200)]),
    "many": (SMALL, [(v, v + 4, u, u + 60) for v in range(10, 230, 12) for u in (10, 90, 170)]),
    "touching side by side": (SMALL, [(100, 108, 40, 200), (108, 116, 40, 200)]),
    "touching end to end": (SMALL, [(100, 108, 40, 120), (100, 108, 120, 200)]),
    "in one line": (SMALL, [(100, 106, 20, 90), (100, 106, 120, 190), (100, 106, 220, 290)]),
    "enormous": (LARGE, [(440, 640, 0, 1440)]),
}


class Twice(RecordedSegmenter):
    """A segmenter that finds everything two times."""

    def segment(self, view):
        return [mask for mask in super().segment(view) for _ in range(2)]


def view_of(scene, index=0):
    """A view of flat wood one metre away, in front of nothing."""
    (height, width), boxes = SCENES[scene]
    instances = np.zeros((height, width), dtype=np.uint16)
    for number, (top, bottom, left, right) in enumerate(boxes, start=1):
        instances[top:bottom, left:right] = number
    lens = Intrinsics(
        fx_px=width,
        fy_px=width,
        cx_px=width / 2,
        cy_px=height / 2,
        width_px=width,
        height_px=height,
    )
    return View(
        index=index,
        stamp_ns=0,
        color_rgb=np.zeros((height, width, 3), dtype=np.uint8),
        intrinsics=lens,
        base_from_camera=np.eye(4),
        depth_m=np.where(instances > 0, np.float32(1), np.float32(2)),
        instances=instances,
        scores=(0.9,) * len(boxes),
    )


def skeleton_of(*views, name, segmenter=None):
    maker = Skeletonizer(segmenter or RecordedSegmenter(), MethodConfig(name=name))
    for view in views:
        maker.add_view(view)
    return maker.skeleton().graph


@pytest.mark.parametrize("name", METHODS)
@pytest.mark.parametrize("scene", SCENES)
def test_a_forest_comes_out_and_what_is_seen_lies_in_the_wood(scene, name):
    view = view_of(scene)
    graph = skeleton_of(view, name=name)
    count, _ = graph.components()
    assert len(graph.edges) == len(graph.vertices_in_base) - count
    assert np.isfinite(graph.vertices_in_base).all()
    assert (len(graph.vertices_in_base) > 0) == bool(SCENES[scene][1])
    seen = graph.vertices_in_base[~graph.occluded]
    pixels = view.intrinsics.project(seen) if len(seen) else np.zeros((0, 2))
    wood = np.argwhere(view.instances > 0)[:, ::-1] if len(seen) else np.zeros((1, 2))
    assert (cKDTree(wood).query(pixels)[0] < 2.0).all()


@pytest.mark.parametrize("name", sorted(JOINERS))
def test_wood_in_one_line_is_joined_along_it(name):
    graph = skeleton_of(view_of("in one line"), name=name)
    assert graph.components()[0] == 1
    assert np.ptp(graph.vertices_in_base[:, 1]) < 0.005


@pytest.mark.parametrize("name", METHODS)
@pytest.mark.parametrize("scene", ["one", "touching side by side", "in one line"])
def test_what_is_seen_twice_lies_where_it_lay(scene, name):
    once = skeleton_of(view_of(scene), name=name)
    for twice in (
        skeleton_of(view_of(scene), name=name, segmenter=Twice()),
        skeleton_of(view_of(scene), view_of(scene, index=1), name=name),
    ):
        far, _ = cKDTree(once.vertices_in_base).query(twice.vertices_in_base[~twice.occluded])
        assert far.max() < 0.006
        assert len(twice.edges) == len(twice.vertices_in_base) - twice.components()[0]
