"""Bad input gets one line that names file, topic, view and mend; it never costs other views."""

import os
import re
import struct
import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from mcap.opcode import Opcode
from mcap.writer import CompressionType

from canopy_skel.document import RejectedView
from canopy_skel.errors import RecordingError
from canopy_skel.frame import View
from canopy_skel.messages import (
    StampedTransform,
    encode_compressed_image,
    encode_raw_image,
    encode_scores,
    encode_transforms,
)
from canopy_skel.recording import RecordingWriter, TopicOptions, mcap_file, read_recording

COLOR, DEPTH, TF = "/camera/color/image", "/camera/depth/image", "/tf"
INSTANCES, SCORES = "/camera/branches/instances", "/camera/branches/scores"
BROKEN = 1


@pytest.fixture
def read_broken(kit, depth_only, tmp_path):
    """Break the messages of view 1 of 4 and return its reason; the others must not care."""

    def read(**changes: bytes | None) -> str:
        messages = []
        for view in depth_only:
            by_topic = kit.messages_of(view)
            if view.index == BROKEN:
                for topic, data in changes.items():
                    if data is None:
                        del by_topic[topic]
                    else:
                        by_topic[topic] = replace(by_topic[topic], data=data)
            messages.extend(by_topic.values())
        recording = read_recording(kit.write_raw(tmp_path / "a.mcap", messages))
        found = list(recording.views())
        assert recording.view_count == len(depth_only)
        assert [one.index for one in found] == [view.index for view in depth_only]
        for one, written in zip(found, depth_only, strict=True):
            if one.index != BROKEN:
                kit.assert_same_view(one, written)
        rejected = found[BROKEN]
        assert isinstance(rejected, RejectedView)
        assert "\n" not in rejected.reason
        assert rejected.reason.startswith("view 1: ")
        return rejected.reason

    return read


def _tf(view: View, quaternion=(0.0, 0.0, 0.0, 1.0), translation=(0.0, 0.0, 0.0)) -> bytes:
    return encode_transforms(
        [
            StampedTransform(
                stamp_ns=view.stamp_ns,
                parent="base",
                child="tool0",
                translation_m=translation,
                quaternion_xyzw=quaternion,
            )
        ]
    )


def _image(view: View, pixels: np.ndarray, encoding: str, late_ns: int = 0) -> bytes:
    return encode_raw_image(pixels, encoding, view.stamp_ns + late_ns, "camera_color_optical_frame")


def test_no_such_file(tmp_path):
    with pytest.raises(RecordingError, match=r"gone\.mcap: no such file; check the path"):
        read_recording(tmp_path / "gone.mcap")


def test_a_folder_is_no_recording(tmp_path):
    with pytest.raises(RecordingError, match=r"is a folder; name the MCAP file in it$"):
        read_recording(tmp_path)


def test_a_disk_that_does_not_give_what_it_has(kit, tmp_path):
    """The memory of this process opens well and cannot be read at its beginning: EIO."""
    (tmp_path / "bad.mcap").symlink_to("/proc/self/mem")
    with pytest.raises(RecordingError, match=r"bad\.mcap: cannot be read \(Input/output error\)"):
        read_recording(tmp_path / "bad.mcap")
    recording = read_recording(kit.write(tmp_path / "turned_bad.mcap"))
    recording.path.unlink()
    recording.path.symlink_to("/proc/self/mem")
    for ask in (lambda: recording.view(0), lambda: recording.ground_truth):
        with pytest.raises(RecordingError, match=r"turned_bad\.mcap: cannot be read"):
            ask()


@pytest.mark.parametrize(
    ("content", "text"), [(b"", "is empty"), (b"#ROSBAG V2.0\n" * 9, "is not an MCAP file")]
)
def test_not_mcap(tmp_path, content, text):
    (tmp_path / "a.bag").write_bytes(content)
    with pytest.raises(RecordingError, match=rf"a\.bag: {text}; .*mcap convert"):
        read_recording(tmp_path / "a.bag")


def test_without_a_camera_topic_the_topics_are_listed(kit, tmp_path):
    messages = kit.messages_of(kit.views[0])
    kept = [messages[TF], messages[COLOR], replace(messages[SCORES], topic="/other")]
    path = kit.write_raw(tmp_path / "a.mcap", kept)
    with pytest.raises(RecordingError) as caught:
        read_recording(path)
    text = str(caught.value)
    assert "a.mcap: no usable camera topic: needs /camera/color/image with /camera/depth/i" in text
    assert "/camera/color/image (foxglove.CompressedImage), /other (json), /tf (fox" in text
    assert "\n" not in text


def test_a_recording_without_messages(kit, tmp_path):
    with pytest.raises(RecordingError, match=r"no usable camera topic.* no topic at all"):
        read_recording(kit.write_raw(tmp_path / "a.mcap", []))


def test_missing_calibration(kit, depth_only, tmp_path):
    messages = [
        message
        for view in depth_only
        for message in kit.messages_of(view).values()
        if "calibration" not in message.topic
    ]
    with pytest.raises(RecordingError, match="no camera calibration on /camera/color/calibration"):
        read_recording(kit.write_raw(tmp_path / "a.mcap", messages))


def test_one_calibration_before_the_first_view_is_enough(kit, depth_only, tmp_path):
    messages = [
        message
        for view in depth_only
        for message in kit.messages_of(view).values()
        if "calibration" not in message.topic or view.index == 0
    ]
    read = list(read_recording(kit.write_raw(tmp_path / "a.mcap", messages)).views())
    for view, written in zip(read, depth_only, strict=True):
        kit.assert_same_view(view, written)


def test_a_calibration_after_a_view_does_not_count(kit, depth_only, tmp_path):
    messages = [
        message
        for view in depth_only
        for message in kit.messages_of(view).values()
        if "calibration" not in message.topic or view.index == 1
    ]
    first, *others = read_recording(kit.write_raw(tmp_path / "a.mcap", messages)).views()
    assert "view 0: /camera/color/calibration: missing; record it" in first.reason
    assert [view.index for view in others if isinstance(view, View)] == [1, 2, 3]


def test_uncalibrated_camera(read_broken):
    calibration = CameraCalibration(width=64, height=48, K=[0.0] * 9, R=[0.0] * 9, P=[0.0] * 12)
    reason = read_broken(**{"/camera/color/calibration": calibration.SerializeToString()})
    assert "/camera/color/calibration: K has no focal length (fx = 0, fy = 0); calibrate" in reason


EYE = (1.0, 0, 0, 0, 1.0, 0, 0, 0, 1.0)


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"D": [0.0, float("nan")]}, "D must be finite numbers, not [0, nan];"),
        ({"P": [0.0, 0, 0, 1, 0, 0, 0, 0, 0, 0, 1, 0]}, "P has no focal length (fx = 0, fy = 0)"),
        ({"R": [2.0, *EYE[1:]]}, "R is no rotation: [2, 0, 0, 0, 1, 0, 0, 0, 1];"),
        ({"R": [*EYE[:8], 0.0]}, "R is no rotation"),
        ({"R": [*EYE[:8], -1.0]}, "R is no rotation"),
        ({"R": [1e300] * 9}, "R is no rotation"),
        ({"R": EYE[:8]}, "R must be 9 finite numbers"),
    ],
)
def test_a_calibration_that_cannot_be(read_broken, changes, text):
    k = [60.0, 0, 31.5, 0, 61.0, 23.5, 0, 0, 1]
    whole = {"width": 64, "height": 48, "distortion_model": "plumb_bob", "K": k}
    data = CameraCalibration(**{**whole, **changes}).SerializeToString()
    reason = read_broken(**{"/camera/color/calibration": data})
    assert f"/camera/color/calibration: {text}" in reason
    assert reason.endswith("; calibrate the camera, or record what its driver publishes")


def test_a_calibration_in_shares_of_the_picture(read_broken):
    k = [0.94, 0, 0.5, 0, 1.27, 0.5, 0, 0, 1]
    data = CameraCalibration(width=64, height=48, distortion_model="plumb_bob", K=k)
    reason = read_broken(**{"/camera/color/calibration": data.SerializeToString()})
    assert "fx = 0.94, fy = 1.27 px is no focal length of a picture of 64x48" in reason


def test_missing_pose(read_broken):
    reason = read_broken(**{TF: None})
    assert "/tf: no pose base -> tool0 at the exposure (the nearest is 1500.0 ms away" in reason
    assert "record the pose at each exposure" in reason


def test_no_pose_at_all(kit, depth_only, tmp_path):
    messages = [m for v in depth_only for m in kit.messages_of(v).values() if m.topic != TF]
    recording = read_recording(kit.write_raw(tmp_path / "a.mcap", messages))
    found = []
    with pytest.raises(RecordingError) as caught:
        found.extend(recording.views())
    assert "a.mcap: none of 4 views is usable; the first: view 0: /tf: no chain" in str(
        caught.value
    )


def test_every_rejected_view_is_told_before_the_error(kit, depth_only, tmp_path):
    messages = [m for v in depth_only for m in kit.messages_of(v).values() if m.topic != TF]
    views = read_recording(kit.write_raw(tmp_path / "a.mcap", messages)).views()
    assert [next(views).index for _ in depth_only] == [0, 1, 2, 3]
    with pytest.raises(RecordingError):
        next(views)


def test_another_base_frame_is_an_option(kit, depth_only, tmp_path):
    messages = [m for v in depth_only for m in kit.messages_of(v).values()]
    path = kit.write_raw(tmp_path / "a.mcap", messages)
    world = next(read_recording(path, TopicOptions(base_frame="tool0")).views())
    np.testing.assert_allclose(world.base_from_camera, kit.tool_from_camera, atol=1e-12)
    lost = read_recording(path, TopicOptions(base_frame="moon"))
    with pytest.raises(RecordingError, match=r"'moon' to 'camera_color_optical_frame' .*base, cam"):
        list(lost.views())


@pytest.mark.parametrize(
    ("pose", "text"),
    [
        (
            {"quaternion": (0.0, 0.0, 0.0, 0.0)},
            "base -> tool0: quaternion .* has no direction; publish a finite",
        ),
        ({"quaternion": (0.0, float("nan"), 0.0, 1.0)}, "quaternion .*nan.* has no direction"),
        (
            {"translation": (0.0, float("inf"), 0.0)},
            r"translation \[0.0, inf, 0.0\] is not finite; publish it in",
        ),
    ],
)
def test_degenerate_pose(kit, read_broken, pose, text):
    assert re.search(text, read_broken(**{TF: _tf(kit.views[BROKEN], **pose)}))


def test_depth_of_another_size(kit, read_broken):
    small = np.full((24, 32), 1000, np.uint16)
    reason = read_broken(**{DEPTH: _image(kit.views[BROKEN], small, "16UC1")})
    assert f"{DEPTH}: is 32x24 but the calibration says 64x48; record both" in reason


def test_depth_all_zero(kit, read_broken):
    nothing = np.zeros((48, 64), np.uint16)
    reason = read_broken(**{DEPTH: _image(kit.views[BROKEN], nothing, "16UC1")})
    assert f"{DEPTH}: holds no return at all (every pixel is 0); check the depth camera" in reason


def test_depth_in_metres_is_understood(kit, depth_only, tmp_path):
    messages = []
    for view in depth_only:
        by_topic = kit.messages_of(view)
        metres = np.where(np.isnan(view.depth_m), np.float32(0), view.depth_m)
        by_topic[DEPTH] = replace(by_topic[DEPTH], data=_image(view, metres, "32FC1"))
        messages.extend(by_topic.values())
    read = read_recording(kit.write_raw(tmp_path / "a.mcap", messages)).views()
    for view, written in zip(read, depth_only, strict=True):
        kit.assert_same_view(view, written)


def test_depth_that_is_a_colour_picture(kit, read_broken):
    grey = np.full((48, 64), 7, np.uint8)
    reason = read_broken(**{DEPTH: _image(kit.views[BROKEN], grey, "mono8")})
    assert f"{DEPTH}: has samples of uint8; depth is 16UC1 (millimetres) or 32FC1" in reason


def test_depth_of_another_moment(kit, read_broken):
    view = kit.views[BROKEN]
    data = _image(view, np.full((48, 64), 900, np.uint16), "16UC1", late_ns=21_000_000)
    reason = read_broken(**{DEPTH: data})
    assert f"{DEPTH}: was taken +21.0 ms from the colour image (limit 20 ms)" in reason


def test_missing_depth(read_broken):
    assert f"{DEPTH}: missing, and there is no stereo pair either; record" in read_broken(
        **{DEPTH: None}
    )


def test_missing_colour(read_broken):
    assert f"{COLOR}: missing; record it" in read_broken(**{COLOR: None})


def test_damaged_colour_picture(kit, read_broken):
    stamp_ns = kit.views[BROKEN].stamp_ns
    data = encode_compressed_image(b"\xff\xd8 torn", "jpeg", stamp_ns, "c")
    assert f"{COLOR}: the jpeg picture (7 bytes) cannot be decoded; record it" in read_broken(
        **{COLOR: data}
    )


def test_bytes_that_are_no_message(read_broken):
    reason = read_broken(**{DEPTH: b"\x0a\xff\xff\xff"})
    assert f"{DEPTH}: is not a foxglove.RawImage (its 4 bytes do not parse); check" in reason


def test_instances_without_scores(read_broken):
    assert f"{SCORES}: missing, but {INSTANCES} is there" in read_broken(**{SCORES: None})


def test_scores_without_instances(read_broken):
    assert f"{INSTANCES}: missing, but {SCORES} is there" in read_broken(**{INSTANCES: None})


def test_an_instance_without_a_score(read_broken):
    reason = read_broken(**{SCORES: encode_scores([0.9, 0.8])})
    assert f"{SCORES}: holds 2 scores but {INSTANCES} has instance 3; give one score per" in reason


@pytest.mark.parametrize(
    ("data", "text"),
    [
        (b'{"scores": 3}', "is not a JSON object"),
        (b'{"points": [1]}', "is not a JSON object"),
        (b"[1, 2, 3]", "is not a JSON object"),
        (b"\xff{", "is not a JSON object"),
        (b'{"scores": "111"}', "is not a JSON object"),
        (b"[" * 100_000, "is not a JSON object"),
        (b'{"scores": [0.5, 0.5, NaN]}', "score 3 is nan, not a number in 0…1; write"),
        (b'{"scores": [0.5, 1.5, 0.5]}', "score 2 is 1.5, not a number in 0…1; write"),
        (b'{"scores": [' + b"9" * 400 + b"]}", "score 1 is 9999"),
        (b'{"scores": ["0.5"]}', "score 1 is '0.5', not a number"),
    ],
)
def test_scores_that_are_none(read_broken, data, text):
    assert f"{SCORES}: {text}" in read_broken(**{SCORES: data})


def test_two_views_with_one_index(kit, depth_only, tmp_path):
    twin = replace(kit.make_view(9), index=1, stereo=None)
    messages = [m for v in (*depth_only, twin) for m in kit.messages_of(v).values()]
    found = list(read_recording(kit.write_raw(tmp_path / "a.mcap", messages)).views())

    assert [one.index for one in found] == [0, 1, 1, 2, 3]
    kit.assert_same_view(found[1], depth_only[1])
    assert isinstance(found[2], RejectedView)
    assert "view 1: a second view with this index; the first is used" in found[2].reason


@pytest.mark.parametrize(
    "lost", [{SCORES}, {INSTANCES, SCORES}, {DEPTH}, {"/camera/color/calibration"}]
)
def test_what_a_view_lost_is_not_taken_from_its_namesake(kit, depth_only, tmp_path, lost):
    twin = replace(kit.make_view(9), index=1, stereo=None, intrinsics=replace(kit.lens, fx_px=99.0))
    messages = [
        m
        for v in (*depth_only, twin)
        for m in kit.messages_of(v).values()
        if not (v is depth_only[BROKEN] and m.topic in lost)
    ]
    alone = [m for m in messages if m.sequence == BROKEN and m.stamp_ns != twin.stamp_ns]
    others = [m for m in messages if m.sequence != BROKEN]
    expected = list(read_recording(kit.write_raw(tmp_path / "b.mcap", [*others, *alone])).views())
    found = list(read_recording(kit.write_raw(tmp_path / "a.mcap", messages)).views())

    assert [one.index for one in found] == [0, 1, 1, 2, 3]
    assert "view 1: a second view with this index" in found.pop(2).reason
    for one, wanted in zip(found, expected, strict=True):
        if isinstance(wanted, View):
            kit.assert_same_view(one, wanted)
        else:
            assert one.reason == wanted.reason


def test_messages_of_a_view_recorded_a_little_apart_stay_together(kit, depth_only, tmp_path):
    twin = replace(kit.make_view(9), index=1, stereo=None)
    messages = [
        replace(m, stamp_ns=m.stamp_ns + 1_000_000 * place) if m.topic != TF else m
        for v in (*depth_only, twin)
        for place, m in enumerate(kit.messages_of(v).values())
    ]
    found = list(read_recording(kit.write_raw(tmp_path / "a.mcap", messages)).views())
    assert "view 1: a second view" in found.pop(2).reason
    for view, written in zip(found, depth_only, strict=True):
        kit.assert_same_view(view, written)


def test_a_pair_of_another_camera_needs_a_depth_image(kit, tmp_path):
    messages = []
    for view in kit.views:
        by_topic = kit.messages_of(view)
        left = by_topic["/camera/left/image"]
        data = encode_raw_image(view.stereo.left_mono, "mono8", view.stamp_ns, "other_camera")
        by_topic["/camera/left/image"] = replace(left, data=data)
        if view.index == 2:
            del by_topic[DEPTH]
        messages.extend(by_topic.values())
    found = list(read_recording(kit.write_raw(tmp_path / "a.mcap", messages)).views())

    assert [getattr(one, "stereo", None) for one in found] == [None] * 4
    assert isinstance(found[2], RejectedView)
    assert f"is of another camera than {COLOR} and there is no depth image" in found[2].reason


def test_only_a_pair_makes_the_left_camera_the_colour_camera(kit, tmp_path):
    messages = [
        message
        for view in kit.views
        for message in kit.messages_of(view).values()
        if "color" not in message.topic and "depth" not in message.topic
    ]
    for view, written in zip(
        read_recording(kit.write_raw(tmp_path / "a.mcap", messages)).views(),
        kit.views,
        strict=True,
    ):
        grey = np.repeat(written.stereo.left_mono[..., None], 3, axis=2)
        kit.assert_same_view(view, replace(written, color_rgb=grey, depth_m=None))


@pytest.mark.parametrize("opcode", [0x80, Opcode.ATTACHMENT, Opcode.CHUNK, Opcode.METADATA])
def test_a_record_that_is_larger_than_memory_is_passed_over(kit, tmp_path, opcode):
    whole = kit.write(tmp_path / "a.mcap").read_bytes()
    after_header = 17 + struct.unpack_from("<Q", whole, 9)[0]
    size = mcap_file.MOST_CHUNK_BYTES + 1
    with (tmp_path / "b.mcap").open("wb") as stream:
        stream.write(whole[:after_header] + struct.pack("<BQ", opcode, size))
        stream.seek(size, os.SEEK_CUR)
        stream.write(whole[after_header:])
    tracemalloc.start()
    try:
        found = list(read_recording(tmp_path / "b.mcap").views())
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert peak < size / 8
    for view, written in zip(found, kit.views, strict=True):
        kit.assert_same_view(view, written)


def test_an_attachment_is_checked_piece_by_piece(kit, tmp_path):
    content = np.random.default_rng(0).bytes(3_000_000)
    for beyond in (0, 2, 4):  # bytes of its checksum that are in a piece of their own
        data = content[: (1 << 21) - 51 + beyond]
        path = tmp_path / f"{beyond}.mcap"
        with RecordingWriter(path, {}, tool_from_camera=kit.tool_from_camera) as writer:
            writer.write_view(kit.views[0], kit.as_png(kit.views[0]))
            writer.attach("large", "text/plain", data)
        recording = read_recording(path)
        assert recording.warnings == ()
        assert recording.attachment("large") == data
        damaged = bytearray(path.read_bytes())
        damaged[damaged.index(data[:100]) + 1_500_000] ^= 1
        path.write_bytes(damaged)
        recording = read_recording(path)
        assert recording.attachment("large") is None
        assert "checksum of 'large' does not match" in recording.warnings[0]


@pytest.mark.parametrize("compression", [CompressionType.ZSTD, CompressionType.LZ4])
def test_a_chunk_that_holds_too_much_is_damage_and_not_read(
    kit, depth_only, tmp_path, monkeypatch, compression
):
    messages = [m for view in depth_only for m in kit.messages_of(view).values()]
    path = kit.write_raw(tmp_path / "a.mcap", messages, compression=compression)
    assert read_recording(path).view_count == len(depth_only)
    monkeypatch.setattr(mcap_file, "MOST_CHUNK_BYTES", 1000)
    [damage] = mcap_file.scan_mcap(path).damage
    assert "more than 1000" in damage
    monkeypatch.undo()
    content = bytearray(path.read_bytes())
    size_at = content.index(compression.name.lower().encode()) - 16
    said = int.from_bytes(content[size_at : size_at + 8], "little")
    content[size_at : size_at + 8] = (said // 2).to_bytes(8, "little")
    path.write_bytes(content)
    [damage] = mcap_file.scan_mcap(path).damage
    assert f"does not hold the {said // 2} bytes" in damage
