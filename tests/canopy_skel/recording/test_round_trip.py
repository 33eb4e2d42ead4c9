"""What is written can be read: by us, and by others."""

import json

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.records import Schema
from mcap_protobuf.decoder import DecoderFactory

from canopy_skel.document import RejectedView
from canopy_skel.errors import RecordingError, UsageError
from canopy_skel.frame import View
from canopy_skel.messages import TOPICS, Message
from canopy_skel.recording import RecordingWriter, cut_recording, read_recording


@pytest.mark.parametrize("compression", ["zstd", "lz4"])
def test_views_come_back_to_the_bit(kit, tmp_path, compression):
    recording = read_recording(kit.write(tmp_path / "a.mcap", compression=compression))

    read = list(recording.views())

    assert len(read) == recording.view_count == len(kit.views)
    for written, view in zip(kit.views, read, strict=True):
        kit.assert_same_view(written, view)
    assert recording.scan_id == "scan-7"
    assert recording.warnings == ()
    assert recording.ground_truth == b"{}"
    assert recording.attachment("nothing") is None


def test_the_same_views_give_the_same_bytes(kit, tmp_path):
    one, other = kit.write(tmp_path / "a.mcap"), kit.write(tmp_path / "b.mcap")

    assert one.read_bytes() == other.read_bytes()


def test_what_was_read_is_written_to_the_same_bytes(kit, tmp_path):
    first = kit.write(tmp_path / "a.mcap")
    with RecordingWriter(
        tmp_path / "b.mcap", {"scan_id": "scan-7"}, tool_from_camera=kit.tool_from_camera
    ) as writer:
        for written, view in zip(kit.views, read_recording(first).views(), strict=True):
            messages = {m.topic: m.data for m in writer.write_view(view, kit.as_png(view))}
            expected = {m.topic: m.data for m in kit.messages_of(written).values()}
            assert {t: d for t, d in messages.items() if t != "/tf"} == {
                t: d for t, d in expected.items() if t != "/tf"
            }


def test_other_readers_understand_every_message(kit, tmp_path):
    path = kit.write(tmp_path / "a.mcap")

    class Json:
        def decoder_for(self, encoding: str, schema: Schema | None):
            return json.loads if encoding == "json" else None

    with path.open("rb") as stream:
        reader = make_reader(stream, True, decoder_factories=[DecoderFactory(), Json()])
        seen = {}
        for schema, channel, message, decoded in reader.iter_decoded_messages():
            seen.setdefault(message.sequence, {})[channel.topic] = decoded
            assert (schema.name, channel.message_encoding) == (
                TOPICS[channel.topic].schema,
                TOPICS[channel.topic].message_encoding,
            )
            assert message.log_time == kit.views[message.sequence].stamp_ns
        (metadata,) = reader.iter_metadata()

    assert metadata.metadata == {"scan_id": "scan-7"}
    for view in kit.views:
        messages = seen[view.index]
        assert messages["/camera/branches/scores"] == {"scores": list(view.scores)}
        depth = messages["/camera/depth/image"]
        assert (depth.encoding, depth.step, depth.timestamp.ToNanoseconds()) == (
            "16UC1",
            2 * view.intrinsics.width_px,
            view.stamp_ns,
        )
        millimetres = np.frombuffer(depth.data, "<u2").reshape(depth.height, depth.width)
        np.testing.assert_array_equal(
            millimetres, np.nan_to_num(view.depth_m * 1000).round().astype(np.uint16)
        )
        right = messages["/camera/right/calibration"]
        assert right.P[3] == -view.stereo.baseline_m * view.intrinsics.fx_px
        hand_eye, tool = messages["/tf"].transforms
        assert (hand_eye.parent_frame_id, hand_eye.child_frame_id) == (
            "tool0",
            "camera_color_optical_frame",
        )
        assert (tool.parent_frame_id, tool.child_frame_id) == ("base", "tool0")


def test_every_view_is_on_disk_before_the_next(kit, tmp_path):
    part = tmp_path / "a.mcap.part"
    with RecordingWriter(tmp_path / "a.mcap", {"scan_id": "s"}) as writer:
        for count, view in enumerate(kit.views, start=1):
            writer.write_view(view)
            recording = read_recording(part)
            assert [one.index for one in recording.views()] == list(range(count))
            assert recording.scan_id == "s"
            assert f"{count} whole views" in recording.warnings[0]
        assert not (tmp_path / "a.mcap").exists()

    assert not part.exists()
    assert read_recording(tmp_path / "a.mcap").warnings == ()


def test_a_scan_that_fails_leaves_its_part_file(kit, tmp_path):
    def scan() -> None:
        with RecordingWriter(tmp_path / "a.mcap", {}) as writer:
            writer.write_view(kit.views[0])
            raise RuntimeError("the arm stopped")

    with pytest.raises(RuntimeError, match="the arm stopped"):
        scan()

    assert not (tmp_path / "a.mcap").exists()
    assert [v.index for v in read_recording(tmp_path / "a.mcap.part").views()] == [0]
    with (
        pytest.raises(RecordingError, match=r"a\.mcap\.part: is there already.*recover"),
        RecordingWriter(tmp_path / "a.mcap", {}),
    ):
        pass


def test_encoded_messages_pass_unchanged(kit, tmp_path):
    messages = list(kit.messages_of(kit.views[2]).values())
    with RecordingWriter(tmp_path / "a.mcap", {}) as writer:
        writer.write_messages(messages)

    recording = read_recording(tmp_path / "a.mcap")
    with (tmp_path / "a.mcap").open("rb") as stream:
        found = [
            Message(topic=c.topic, stamp_ns=m.log_time, sequence=m.sequence, data=m.data)
            for _, c, m in make_reader(stream).iter_messages()
        ]
    assert found == messages
    kit.assert_same_view(next(recording.views()), kit.views[2])


def test_events_are_kept_beside_the_views(kit, tmp_path):
    with RecordingWriter(tmp_path / "a.mcap", {}) as writer:
        writer.write_event(kit.views[0].stamp_ns, {"state": "moving"})
        writer.write_view(kit.views[0])

    recording = read_recording(tmp_path / "a.mcap")
    assert {(t.topic, t.messages) for t in recording.topics} >= {("/scan/event", 1)}
    assert [view.index for view in recording.views()] == [0]


def test_a_view_is_written_once(kit, tmp_path):
    with RecordingWriter(tmp_path / "a.mcap", {}) as writer:
        writer.write_view(kit.views[0])
        with pytest.raises(UsageError, match="view 0 is written already"):
            writer.write_view(kit.views[0])


@pytest.mark.parametrize("name", ["no/such/folder/a.mcap", "file/a.mcap"])
def test_a_folder_that_cannot_be_written_is_named(tmp_path, name):
    (tmp_path / "file").write_text("not a folder")
    with (
        pytest.raises(RecordingError, match=r"a\.mcap: cannot be written .*choose a folder"),
        RecordingWriter(tmp_path / name, {}),
    ):
        pass


def test_an_existing_recording_is_never_overwritten(kit, tmp_path):
    path = kit.write(tmp_path / "a.mcap")
    before = path.read_bytes()

    with pytest.raises(RecordingError, match="is there already"), RecordingWriter(path, {}):
        pass

    assert path.read_bytes() == before


def test_cutting_keeps_the_bytes_of_the_views_that_stay(kit, tmp_path):
    source = kit.write(tmp_path / "a.mcap")
    cut_recording(source, tmp_path / "b.mcap", [3, 1])

    assert _pictures(tmp_path / "b.mcap") == [
        message for message in _pictures(source) if message.sequence in (1, 3)
    ]
    cut = read_recording(tmp_path / "b.mcap")
    views = list(cut.views())
    assert [view.index for view in views] == [1, 3]
    for view in views:
        assert isinstance(view, View)
        kit.assert_same_view(view, kit.views[view.index])
    assert (cut.scan_id, cut.ground_truth) == ("scan-7", b"{}")
    with pytest.raises(UsageError, match=r"no view \[9\]; it has 0, 1, 2, 3"):
        cut_recording(source, tmp_path / "c.mcap", [9, 1])
    assert not (tmp_path / "c.mcap").exists()


def test_views_come_in_ascending_order(kit, tmp_path):
    order = [2, 0, 3]
    messages = [m for i in order for m in kit.messages_of(kit.views[i]).values()]
    read = list(read_recording(kit.write_raw(tmp_path / "a.mcap", messages)).views())

    assert [view.index for view in read] == [0, 2, 3]
    assert not any(isinstance(view, RejectedView) for view in read)


def _pictures(path):
    with path.open("rb") as stream:
        return [
            Message(topic=c.topic, stamp_ns=m.log_time, sequence=m.sequence, data=m.data)
            for _, c, m in make_reader(stream, True).iter_messages()
            if c.topic != "/tf" and "calibration" not in c.topic
        ]
