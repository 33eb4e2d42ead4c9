"""Instances go into a copy of a recording; what others wrote keeps its bytes."""

from dataclasses import replace

import numpy as np
import pytest
from mcap.reader import make_reader

from canopy_skel.document import RejectedView
from canopy_skel.errors import RecordingError, ViewError
from canopy_skel.messages import INSTANCES, SCORES
from canopy_skel.recording import RecordingWriter, annotate, read_recording
from canopy_skel.segment import BranchMask

OWN = {INSTANCES.name, SCORES.name}


def found_in(view):
    """Two overlapping instances that depend on the view; the second is surer."""
    first = np.ones((4, 10 + view.index), bool)
    return [
        BranchMask(instance=1, left_px=3, top_px=2, mask=first, confidence=0.5),
        BranchMask(instance=2, left_px=0, top_px=4, mask=np.ones((9, 5), bool), confidence=0.75),
    ]


def rows(path, *, own):
    with path.open("rb") as stream:
        return [
            (channel.topic, schema.data, m.sequence, m.log_time, m.publish_time, m.data)
            for schema, channel, m in make_reader(stream).iter_messages(log_time_order=False)
            if (channel.topic in OWN) == own
        ]


@pytest.fixture(params=["with old instances", "without"])
def scanned(kit, tmp_path, request):
    path = tmp_path / "scan.mcap"
    with RecordingWriter(path, {"scan_id": "s"}, tool_from_camera=kit.tool_from_camera) as writer:
        writer.write_event(5, {"kind": "start"})
        for view in kit.views[:3]:
            if request.param == "without":
                view = replace(view, instances=None, scores=None)
            writer.write_view(view, kit.as_png(view))
            writer.write_event(view.stamp_ns + 1, {"kind": "captured", "index": view.index})
        writer.attach("notes.txt", "text/plain", b"dry")
    return path


def nothing(done, total):
    pass


def test_the_copy_holds_the_instances_and_everything_else_unchanged(kit, scanned, tmp_path):
    before, steps = scanned.read_bytes(), []
    target = tmp_path / "copy.mcap"
    without = annotate(
        read_recording(scanned), target, found_in, lambda done, total: steps.append((done, total))
    )
    assert (without, steps) == ([], [(1, 3), (2, 3), (3, 3)])
    assert scanned.read_bytes() == before
    assert rows(target, own=False) == rows(scanned, own=False)
    copy = read_recording(target)
    assert (copy.scan_id, copy.attachment("notes.txt"), copy.warnings) == ("s", b"dry", ())
    for view, written in zip(copy.views(), kit.views, strict=False):
        expected = np.zeros(view.instances.shape, int)
        expected[2:6, 3 : 13 + view.index] = 1
        expected[4:13, 0:5] = 2
        assert np.array_equal(view.instances, expected)
        assert view.scores == (0.5, 0.75)
        kit.assert_same_view(
            replace(view, instances=written.instances, scores=written.scores), written
        )


def test_the_copy_of_a_copy_is_the_copy(scanned, tmp_path):
    one, two = tmp_path / "one.mcap", tmp_path / "two.mcap"
    annotate(read_recording(scanned), one, found_in, nothing)
    annotate(read_recording(one), two, found_in, nothing)
    assert one.read_bytes() == two.read_bytes()


def test_a_view_nothing_can_be_found_in_is_copied_without_and_named(scanned, tmp_path):
    def picky(view):
        if view.index == 1:
            raise ViewError("view 1: too dark")
        return [] if view.index == 2 else found_in(view)

    target = tmp_path / "copy.mcap"
    without = annotate(read_recording(scanned), target, picky, nothing)
    assert without == [RejectedView(index=1, reason="view 1: too dark")]
    views = list(read_recording(target).views())
    assert [view.scores for view in views] == [(0.5, 0.75), None, ()]
    assert rows(target, own=False) == rows(scanned, own=False)


def test_an_existing_recording_is_not_overwritten(scanned):
    with pytest.raises(RecordingError, match=r"scan\.mcap: is there already"):
        annotate(read_recording(scanned), scanned, found_in, nothing)


def test_distorted_pictures_are_refused_with_the_way_out(kit, tmp_path):
    path = distorted(kit, tmp_path / "bent.mcap")
    with pytest.raises(RecordingError, match=r"bent\.mcap: its pictures are distorted.*--segment"):
        annotate(read_recording(path), tmp_path / "copy.mcap", found_in, nothing)
    assert not (tmp_path / "copy.mcap").exists()


def distorted(kit, path):
    from canopy_skel.messages import COLOR_CALIBRATION, FoxgloveDecoder, encode_calibration

    messages = kit.messages_of(kit.views[0])
    told = messages[COLOR_CALIBRATION.name]
    lens = FoxgloveDecoder().calibration("foxglove.CameraCalibration", told.data)
    bent = replace(lens, d=np.array([0.1, 0.0, 0.0, 0.0, 0.0]))
    messages[COLOR_CALIBRATION.name] = replace(told, data=encode_calibration(bent))
    return kit.write_raw(path, list(messages.values()))
