"""Small scans, and a writer that writes whatever a broken recorder would."""

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from mcap.writer import Writer
from scipy.spatial.transform import Rotation

from canopy_skel.frame import Intrinsics, StereoPair, View
from canopy_skel.geometry import transform_from
from canopy_skel.messages import TOPICS, Message
from canopy_skel.recording import EncodedPicture, RecordingWriter, encode_view

LENS = Intrinsics(fx_px=60.0, fy_px=61.0, cx_px=31.5, cy_px=23.5, width_px=64, height_px=48)
TOOL_FROM_CAMERA = transform_from(
    Rotation.from_euler("xyz", [0.1, -0.2, 0.3]).as_matrix(), [0.01, -0.04, 0.06]
)
FIRST_STAMP_NS = 1_760_000_000_123_456_789


def make_view(index: int, seed: int = 0) -> View:
    """Return a view with everything in it; depth is in whole millimetres, as a file keeps it."""
    rng = np.random.default_rng([seed, index])
    size = (LENS.height_px, LENS.width_px)
    millimetres = rng.integers(300, 3000, size).astype(np.float32)
    millimetres[rng.random(size) < 0.3] = np.nan
    rotation = Rotation.random(rng=rng).as_matrix()
    return View(
        index=index,
        stamp_ns=FIRST_STAMP_NS + 1_500_000_000 * index,
        color_rgb=rng.integers(0, 256, (*size, 3), dtype=np.uint8),
        intrinsics=LENS,
        base_from_camera=transform_from(rotation, rng.normal(size=3)),
        depth_m=millimetres / np.float32(1000),
        stereo=StereoPair(
            left_mono=rng.integers(0, 256, size, dtype=np.uint8),
            right_mono=rng.integers(0, 256, size, dtype=np.uint8),
            intrinsics=LENS,
            baseline_m=0.075,
        ),
        instances=rng.integers(0, 4, size, dtype=np.uint16),
        scores=(0.5, 0.25, 1.0),
    )


def as_png(view: View) -> EncodedPicture:
    """Return the colour picture without loss."""
    done, data = cv2.imencode(".png", view.color_rgb[..., ::-1])
    assert done
    return EncodedPicture(data=data.tobytes(), format="png")


def assert_same_view(one: View, other: View) -> None:
    """Compare two views: pixels to the bit, poses to rounding."""
    assert (one.index, one.stamp_ns, one.intrinsics) == (
        other.index,
        other.stamp_ns,
        other.intrinsics,
    )
    np.testing.assert_array_equal(one.color_rgb, other.color_rgb)
    np.testing.assert_array_equal(one.depth_m, other.depth_m)
    np.testing.assert_array_equal(one.instances, other.instances)
    assert one.scores == other.scores
    np.testing.assert_allclose(one.base_from_camera, other.base_from_camera, atol=1e-12)
    assert (one.stereo is None) == (other.stereo is None)
    if one.stereo is not None and other.stereo is not None:
        np.testing.assert_array_equal(one.stereo.left_mono, other.stereo.left_mono)
        np.testing.assert_array_equal(one.stereo.right_mono, other.stereo.right_mono)
        assert one.stereo.intrinsics == other.stereo.intrinsics
        assert one.stereo.baseline_m == pytest.approx(other.stereo.baseline_m, rel=1e-12)


def messages_of(view: View) -> dict[str, Message]:
    """Return the messages of a view by topic, the colour picture without loss."""
    encoded = encode_view(view, TOOL_FROM_CAMERA, as_png(view))
    return {message.topic: message for message in encoded}


def write_raw(path: Path, messages: Iterable[Message], **options: object) -> Path:
    """Write any messages, each topic with its schema of the table (unknown topics: none).

    options: of the stock MCAP writer.
    """
    with path.open("wb") as stream:
        writer = Writer(stream, **options)
        writer.start()
        channels: dict[str, int] = {}
        for message in messages:
            topic = TOPICS.get(message.topic)
            if message.topic not in channels and topic is not None:
                schema = writer.register_schema(
                    topic.schema, topic.schema_encoding, topic.schema_data()
                )
                channels[message.topic] = writer.register_channel(
                    message.topic, topic.message_encoding, schema
                )
            elif message.topic not in channels:
                channels[message.topic] = writer.register_channel(message.topic, "json", 0)
            writer.add_message(
                channels[message.topic],
                message.stamp_ns,
                message.data,
                message.stamp_ns,
                message.sequence,
            )
        writer.finish()
    return path


class Kit:
    """What the tests of recordings share: four views, and the functions above."""

    tool_from_camera = TOOL_FROM_CAMERA
    lens = LENS
    make_view = staticmethod(make_view)
    as_png = staticmethod(as_png)
    assert_same_view = staticmethod(assert_same_view)
    messages_of = staticmethod(messages_of)
    write_raw = staticmethod(write_raw)

    def __init__(self) -> None:
        self.views = tuple(make_view(index) for index in range(4))

    def write(self, path: Path, **options: object) -> Path:
        """Write the views with the product's own writer."""
        with RecordingWriter(
            path, {"scan_id": "scan-7"}, tool_from_camera=self.tool_from_camera, **options
        ) as writer:
            for view in self.views:
                writer.write_view(view, as_png(view))
            writer.attach("ground_truth_skeleton.json", "application/json", b"{}")
        return path


@pytest.fixture(scope="session")
def kit() -> Kit:
    return Kit()


@pytest.fixture
def depth_only(kit: Kit) -> tuple[View, ...]:
    """The views of a camera with depth and without a pair."""
    return tuple(replace(view, stereo=None) for view in kit.views)
