from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from canopy_skel.pipeline import MethodConfig, Skeletonizer
from canopy_skel.recording import RecordingWriter, read_recording
from canopy_skel.segmenters.recorded import RecordedSegmenter
from service.replay import ReplayRequest, replay

DEMO = Path(__file__).parents[2] / "recordings/demo_apple.mcap"


@pytest.fixture(scope="module")
def views():
    return list(read_recording(DEMO).views())


def shifted(view, by_m):
    base_from_camera = np.array(view.base_from_camera)
    base_from_camera[:3, 3] += by_m
    return replace(view, base_from_camera=base_from_camera)


@pytest.mark.parametrize(("by_m", "alone"), [(0.0, []), (0.04, [3])])
def test_a_view_that_is_centimetres_off_is_named(views, by_m, alone):
    maker = Skeletonizer(RecordedSegmenter(), MethodConfig(name="canopy"))
    for view in views:
        maker.add_view(shifted(view, [0, by_m, 0]) if view.index == 3 else view)
    lone_views = maker.skeleton().lone_views
    assert [maker.views[one.view] for one in lone_views] == alone


def test_a_replay_says_so(views, tmp_path):
    path = tmp_path / "moved.mcap"
    with RecordingWriter(path, {"scan_id": "moved"}) as writer:
        for view in views:
            writer.write_view(shifted(view, [0, 0.04, 0]) if view.index == 3 else view)
    request = ReplayRequest(
        config=MethodConfig(name="canopy"),
        segmenter="recorded",
        formats=("json",),
        topics=None,
        memory_limit_bytes=1 << 32,
    )
    [warning] = replay(path, tmp_path, request, lambda done, total: None).warnings
    assert "view 3" in warning
    assert "centimetres off" in warning
