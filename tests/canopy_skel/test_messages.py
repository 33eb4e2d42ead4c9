"""Messages: bytes to arrays and back, and others' decoders understand the schemas."""

import math
from contextlib import suppress

import cv2
import numpy as np
import pytest
from google.protobuf.descriptor_pb2 import FileDescriptorSet
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays
from mcap.records import Schema
from mcap_protobuf.decoder import DecoderFactory

from canopy_skel.messages import (
    TOPICS,
    FoxgloveDecoder,
    StampedTransform,
    decode_scores,
    encode_compressed_image,
    encode_raw_image,
    encode_scores,
    encode_transforms,
)
from canopy_skel.pixels import as_depth_m, depth_to_millimetres, pixels_from_raw

shapes = st.tuples(st.integers(1, 5), st.integers(1, 7))
stamps = st.integers(0, 2**62)
finite = st.floats(-1e9, 1e9)


@given(arrays.arrays(np.uint16, shapes), stamps)
def test_depth_images_keep_every_bit(millimetres, stamp_ns):
    data = encode_raw_image(millimetres, "16UC1", stamp_ns, "eye")
    picture = FoxgloveDecoder().picture("foxglove.RawImage", data)
    assert (picture.stamp_ns, picture.frame_id) == (stamp_ns, "eye")
    np.testing.assert_array_equal(picture.pixels, millimetres)


@given(arrays.arrays(np.uint16, shapes, elements=st.integers(0, 65535)))
def test_millimetres_survive_metres(millimetres):
    if not millimetres.any():
        with pytest.raises(ValueError, match="holds no return at all"):
            as_depth_m(millimetres)
        return
    metres = as_depth_m(millimetres)
    assert np.isnan(metres[millimetres == 0]).all()
    np.testing.assert_array_equal(depth_to_millimetres(metres), millimetres)


def test_what_is_no_depth_becomes_nan_and_then_zero():
    metres = as_depth_m(np.array([[1.5, 0.0, -1.0, np.inf, np.nan, 70.0]], np.float32))
    np.testing.assert_array_equal(metres, np.float32([[1.5, *[np.nan] * 4, 70.0]]))
    assert depth_to_millimetres(metres).tolist() == [[1500, 0, 0, 0, 0, 0]]


@given(
    st.sampled_from(["mono8", "16UC1", "32FC1", "rgb8", "bgr8", "rgba8", "bgra8"]),
    shapes,
    st.integers(0, 9),
    st.booleans(),
    st.randoms(use_true_random=False),
)
def test_raw_pixels_of_any_layout(encoding, shape, padding, is_bigendian, random):
    channels = {"rgb8": 3, "bgr8": 3, "rgba8": 4, "bgra8": 4}.get(encoding, 1)
    dtype = np.dtype({"16UC1": "u2", "32FC1": "f4"}.get(encoding, "u1"))
    values = np.array([random.randrange(256) for _ in range(math.prod(shape) * channels)])
    pixels = values.reshape(*shape, channels).astype(dtype)
    order = ">" if is_bigendian else "<"
    rows = [row.astype(dtype.newbyteorder(order)).tobytes() + b"#" * padding for row in pixels]

    found = pixels_from_raw(
        b"".join(rows),
        width_px=shape[1],
        height_px=shape[0],
        step=len(rows[0]),
        encoding=encoding,
        is_bigendian=is_bigendian,
    )

    rgb = pixels[..., [2, 1, 0]] if encoding.startswith("bgr") else pixels[..., :3]
    np.testing.assert_array_equal(found, rgb if channels > 1 else pixels[..., 0])
    assert found.dtype == dtype


@pytest.mark.parametrize(
    "changes",
    [{"width_px": 0}, {"height_px": 4}, {"step": 5}, {"encoding": "yuv"}, {"data": b"short"}],
)
def test_numbers_that_do_not_fit_the_data(changes):
    layout = {
        "data": bytes(18),
        "width_px": 3,
        "height_px": 3,
        "step": 6,
        "encoding": "16UC1",
    }
    with pytest.raises(ValueError, match=r"does not fit|is not one of"):
        pixels_from_raw(**{**layout, **changes})


def test_a_turned_jpeg_is_not_turned_again():
    """The orientation a phone notes in a picture is not the camera's geometry."""
    done, jpeg = cv2.imencode(".jpg", np.zeros((8, 16, 3), np.uint8))
    assert done
    exif = b"Exif\0\0MM\0*\0\0\0\x08\0\x01\x01\x12\0\x03\0\0\0\x01\0\x06\0\0\0\0\0\0"
    turned = jpeg.tobytes()[:2] + b"\xff\xe1" + (len(exif) + 2).to_bytes(2, "big") + exif
    data = encode_compressed_image(turned + jpeg.tobytes()[2:], "jpeg", 0, "eye")
    assert FoxgloveDecoder().picture("foxglove.CompressedImage", data).pixels.shape == (8, 16, 3)


def test_compressed_pictures_are_rgb():
    bgr = np.zeros((4, 4, 3), np.uint8)
    bgr[..., 0] = 200
    png = cv2.imencode(".png", bgr)[1].tobytes()
    data = encode_compressed_image(png, "png", 5, "eye")
    picture = FoxgloveDecoder().picture("foxglove.CompressedImage", data)
    assert picture.pixels[0, 0].tolist() == [0, 0, 200]


@given(
    st.lists(
        st.builds(
            StampedTransform,
            stamp_ns=stamps,
            parent=st.text(max_size=5),
            child=st.text(max_size=5),
            translation_m=st.tuples(finite, finite, finite),
            quaternion_xyzw=st.tuples(finite, finite, finite, finite),
        ),
        max_size=3,
    )
)
def test_transforms_come_back_exactly(transforms):
    data = encode_transforms(transforms)
    assert list(FoxgloveDecoder().transforms("foxglove.FrameTransforms", data)) == transforms


@given(st.lists(st.floats(0, 1), max_size=5))
def test_scores_come_back_exactly(scores):
    assert list(decode_scores(encode_scores(scores))) == scores


@given(st.sampled_from(["picture", "calibration", "transforms", "scores"]), st.binary(max_size=60))
def test_any_bytes_are_decoded_or_refused_with_a_value_error(method, data):
    schema = {
        "picture": "foxglove.RawImage",
        "calibration": "foxglove.CameraCalibration",
        "transforms": "foxglove.FrameTransforms",
    }
    with suppress(ValueError):
        getattr(FoxgloveDecoder(), method)(schema.get(method, ""), data)


@pytest.mark.parametrize("topic", [t for t in TOPICS.values() if t.message_class is not None])
def test_schemas_are_complete_for_a_reader_that_knows_none(topic):
    files = FileDescriptorSet.FromString(topic.schema_data()).file
    known = set()
    for file in files:
        assert set(file.dependency) <= known, "dependencies come first"
        known.add(file.name)
    schema = Schema(id=1, name=topic.schema, encoding="protobuf", data=topic.schema_data())
    decode = DecoderFactory().decoder_for("protobuf", schema)
    assert decode is not None
    assert decode(b"").DESCRIPTOR.full_name == topic.schema


def test_a_message_of_another_schema_is_named():
    with pytest.raises(ValueError, match=r"holds foxglove\.Log, not foxglove\.RawImage or"):
        FoxgloveDecoder().picture("foxglove.Log", b"")
