"""One view at a time: decoded from its own messages, taken from a file that is being written."""

from dataclasses import fields, is_dataclass, replace
from itertools import islice

import numpy as np
import pytest

from canopy_skel.document import RejectedView
from canopy_skel.errors import RecordingError, UsageError, ViewError
from canopy_skel.messages import TRANSFORMS
from canopy_skel.recording import (
    RecordingWriter,
    TopicOptions,
    messages_of_view,
    read_recording,
    view_from_messages,
)


def assert_identical(one, other):
    """Compare two values bit by bit, arrays and their types included."""
    assert type(one) is type(other)
    if isinstance(one, np.ndarray):
        assert (one.dtype, one.shape) == (other.dtype, other.shape)
        assert one.tobytes() == other.tobytes()
    elif is_dataclass(one):
        for field in fields(one):
            assert_identical(getattr(one, field.name), getattr(other, field.name))
    else:
        assert one == other


def test_messages_alone_give_the_view_of_the_recording(kit, tmp_path):
    path = tmp_path / "scan.mcap"
    views = [kit.make_view(index) for index in range(4)]
    views[1] = replace(views[1], stereo=None)
    views[2] = replace(views[2], depth_m=None)
    views[3] = replace(views[3], instances=None, scores=None)
    with RecordingWriter(path, {}, tool_from_camera=kit.tool_from_camera) as writer:
        written = [writer.write_view(view) for view in views]
        writer.write_event(views[0].stamp_ns, {"kind": "view"})
    recording = read_recording(path)
    for index, whole in enumerate(recording.views()):
        assert_identical(view_from_messages(written[index]), whole)
        assert messages_of_view(recording, index) == written[index]


@pytest.mark.parametrize("name", ["apple_dense", "walnut_stereo"])
def test_a_view_stands_alone_where_the_recording_says_some_things_once(
    kit, shared_recording, tmp_path, name
):
    """These say the hand-eye transform with the first view only; now the calibrations, too."""
    recording = read_recording(shared_recording(name))
    messages = [
        message
        for group in recording.groups
        for message in messages_of_view(recording, group.index)
        if group.index == 0 or "calibration" not in message.topic
    ]
    once = read_recording(kit.write_raw(tmp_path / "once.mcap", messages))
    for view in islice(recording.views(), 3):
        for source in (recording, once):
            assert_identical(view_from_messages(messages_of_view(source, view.index)), view)


@pytest.mark.parametrize("name", ["apple_dense", "walnut_stereo"])
def test_orchard_views_are_the_same_either_way(shared_recording, tmp_path, name):
    path = tmp_path / "again.mcap"
    with RecordingWriter(path, {}) as writer:
        for view in islice(read_recording(shared_recording(name)).views(), 3):
            writer.write_view(view)
    recording = read_recording(path)
    for whole in recording.views():
        assert_identical(view_from_messages(messages_of_view(recording, whole.index)), whole)


@pytest.mark.parametrize(
    ("topic", "data"),
    [
        ("/camera/depth/image", b"\xff\xff"),
        ("/camera/color/image", b""),
        ("/camera/color/calibration", b""),
        ("/camera/branches/scores", b'{"scores": [2]}'),
        ("/camera/branches/scores", None),
        ("/camera/right/image", None),
    ],
)
def test_an_unusable_view_is_refused_for_the_reason_the_recording_gives(kit, tmp_path, topic, data):
    bad, good = (kit.messages_of(replace(kit.make_view(i), depth_m=None)) for i in range(2))
    if topic == "/camera/depth/image":
        bad = kit.messages_of(kit.make_view(0))
    if data is None:
        del bad[topic]
    else:
        bad[topic] = replace(bad[topic], data=data)
    path = kit.write_raw(tmp_path / "scan.mcap", [*bad.values(), *good.values()])
    recording = read_recording(path)
    rejected, _ = recording.views()
    assert isinstance(rejected, RejectedView)
    with pytest.raises(ViewError) as refused:
        view_from_messages(messages_of_view(recording, 0))
    assert str(refused.value) == rejected.reason


def test_a_view_without_a_readable_pose_is_refused(kit):
    messages = kit.messages_of(kit.make_view(0))
    messages[TRANSFORMS.name] = replace(messages[TRANSFORMS.name], data=b"\xff\xff")
    with pytest.raises(ViewError, match=r"^view 0: /tf: no chain of transforms"):
        view_from_messages(list(messages.values()))


def test_messages_of_several_views_or_of_none_are_refused(kit):
    two = [m for index in (0, 4) for m in kit.messages_of(kit.make_view(index)).values()]
    for messages, named in ((two, r"\[0, 4\]"), ([], r"\[\]")):
        with pytest.raises(ViewError, match=f"are of views {named}, not of one view"):
            view_from_messages(messages)


def test_frames_are_named_by_the_options(kit):
    messages = list(kit.messages_of(kit.make_view(0)).values())
    with pytest.raises(ViewError, match="no chain of transforms from 'world'"):
        view_from_messages(messages, TopicOptions(base_frame="world"))


def test_views_are_taken_from_a_file_that_is_being_written(kit, tmp_path):
    path = tmp_path / "scan.mcap"
    part = tmp_path / "scan.mcap.part"
    with RecordingWriter(path, {}, tool_from_camera=kit.tool_from_camera) as writer:
        written = []
        for index in range(3):
            written.append(writer.write_view(kit.make_view(index)))
            growing = read_recording(part)
            for known in range(index + 1):
                assert messages_of_view(growing, known) == written[known]
            with pytest.raises(UsageError, match=f"no whole view {index + 1}; it has 0"):
                messages_of_view(growing, index + 1)
    with pytest.raises(RecordingError, match="no such file"):
        messages_of_view(growing, 0)
    assert messages_of_view(read_recording(path), 2) == written[2]


def test_a_file_that_was_replaced_gives_no_bytes_of_other_messages(kit, tmp_path):
    path = tmp_path / "scan.mcap"
    with RecordingWriter(path, {}, tool_from_camera=kit.tool_from_camera) as writer:
        written = [writer.write_view(kit.make_view(index)) for index in range(2)]
    known = read_recording(path)
    path.unlink()
    with RecordingWriter(path, {}) as writer:
        writer.write_event(1, {"kind": "running"})
        writer.write_messages(written[0])
    for index in range(2):
        with pytest.raises(RecordingError, match="changed while it was read"):
            messages_of_view(known, index)


@pytest.mark.parametrize("options", [{"use_chunking": False}, {"chunk_size": 1}])
def test_a_file_that_was_cut_since_gives_no_short_messages(kit, tmp_path, options):
    messages = kit.messages_of(kit.make_view(0)).values()
    path = kit.write_raw(tmp_path / "scan.mcap", [*messages], **options)
    known = read_recording(path)
    last = max(known.file.messages, key=lambda ref: (ref.chunk_offset or 0, ref.offset))
    path.write_bytes(path.read_bytes()[: (last.chunk_offset or last.offset) + 20])
    with pytest.raises(RecordingError, match="changed while it was read"):
        messages_of_view(known, 0)


def test_a_view_that_was_cut_is_not_handed_out(kit, tmp_path):
    whole, cut = kit.messages_of(kit.make_view(0)), kit.messages_of(kit.make_view(1))
    del cut["/camera/depth/image"]
    path = kit.write_raw(tmp_path / "scan.mcap", [*whole.values(), *cut.values()], chunk_size=1)
    path.write_bytes(path.read_bytes()[:-40])
    with pytest.raises(UsageError, match="no whole view 1; it has 0"):
        messages_of_view(read_recording(path), 1)
