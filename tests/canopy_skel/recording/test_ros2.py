"""ROS 2 recordings, written by the ROS 2 writer of the mcap project."""

import struct
from dataclasses import replace
from types import SimpleNamespace as Message

import cv2
import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import Writer as McapWriter
from mcap_ros2.writer import Writer
from scipy.spatial.transform import Rotation

from canopy_skel.document import RejectedView
from canopy_skel.errors import RecordingError
from canopy_skel.frame import View
from canopy_skel.geometry import transform_from
from canopy_skel.recording import ROS2_TOPICS, cut_recording, read_recording, recover

MS = 1_000_000
START_NS = 1_700_000_000_000_000_000
SIZE = (40, 30)
K = [50.0, 0.0, 19.5, 0.0, 51.0, 14.5, 0.0, 0.0, 1.0]
FRAME = "camera_color_optical_frame"
SEPARATOR = "\n" + "=" * 80 + "\n"
HEADER = (
    "MSG: std_msgs/Header\nbuiltin_interfaces/Time stamp\nstring frame_id"
    + SEPARATOR
    + "MSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec"
)
SCHEMAS = {
    "sensor_msgs/msg/Image": "std_msgs/Header header\nuint32 height\nuint32 width\n"
    "string encoding\nuint8 is_bigendian\nuint32 step\nuint8[] data" + SEPARATOR + HEADER,
    "sensor_msgs/msg/CompressedImage": "std_msgs/Header header\nstring format\nuint8[] data"
    + SEPARATOR
    + HEADER,
    "sensor_msgs/msg/CameraInfo": "std_msgs/Header header\nuint32 height\nuint32 width\n"
    "string distortion_model\nfloat64[] d\nfloat64[9] k\nfloat64[9] r\nfloat64[12] p"
    + SEPARATOR
    + HEADER,
    "tf2_msgs/msg/TFMessage": "geometry_msgs/TransformStamped[] transforms"
    + SEPARATOR
    + "MSG: geometry_msgs/TransformStamped\nstd_msgs/Header header\nstring child_frame_id\n"
    "geometry_msgs/Transform transform"
    + SEPARATOR
    + "MSG: geometry_msgs/Transform\ngeometry_msgs/Vector3 translation\n"
    "geometry_msgs/Quaternion rotation"
    + SEPARATOR
    + "MSG: geometry_msgs/Vector3\nfloat64 x\nfloat64 y\nfloat64 z"
    + SEPARATOR
    + "MSG: geometry_msgs/Quaternion\nfloat64 x\nfloat64 y\nfloat64 z\nfloat64 w"
    + SEPARATOR
    + HEADER,
    "std_msgs/msg/String": "string data",
}


class Bag:
    """Collects ROS messages and writes them in the order of their log times."""

    def __init__(self) -> None:
        self._messages: list[tuple[int, str, str, Message]] = []

    def add(self, topic: str, schema: str, message: Message, log_ms: float) -> None:
        self._messages.append((START_NS + int(log_ms * MS), topic, schema, message))

    def image(
        self, topic: str, ms: float, pixels: np.ndarray, encoding: str, /, **changes: object
    ) -> None:
        row = pixels.strides[0]
        message = Message(
            header=header(ms),
            height=pixels.shape[0],
            width=pixels.shape[1],
            encoding=encoding,
            is_bigendian=0,
            step=row,
            data=pixels.tobytes(),
        )
        vars(message).update(changes)
        self.add(topic, "sensor_msgs/msg/Image", message, ms + 7)

    def info(self, topic: str, ms: float, **changes) -> None:
        message = Message(
            header=header(ms),
            height=SIZE[1],
            width=SIZE[0],
            distortion_model="plumb_bob",
            d=[0.0] * 5,
            k=K,
            r=[1.0, 0, 0, 0, 1.0, 0, 0, 0, 1.0],
            p=[*K[:3], 0.0, *K[3:6], 0.0, *K[6:], 0.0],
        )
        vars(message).update(changes)
        self.add(topic, "sensor_msgs/msg/CameraInfo", message, ms + 9)

    def transform(self, topic: str, ms: float, parent: str, child: str, pose: np.ndarray) -> None:
        x, y, z, w = Rotation.from_matrix(pose[:3, :3]).as_quat()
        translation = dict(zip("xyz", pose[:3, 3].tolist(), strict=True))
        one = Message(
            header=header(ms, parent),
            child_frame_id=child,
            transform=Message(
                translation=Message(**translation), rotation=Message(x=x, y=y, z=z, w=w)
            ),
        )
        self.add(topic, "tf2_msgs/msg/TFMessage", Message(transforms=[one]), ms + 1)

    def write(self, path):
        with path.open("wb") as stream, Writer(stream, chunk_size=5_000) as writer:
            schemas = {name: writer.register_msgdef(name, text) for name, text in SCHEMAS.items()}
            for log_ns, topic, schema, message in sorted(self._messages, key=lambda m: m[0]):
                writer.write_message(topic, schemas[schema], message, log_ns)
        return path


def header(ms: float, frame_id: str = FRAME) -> Message:
    seconds, nanoseconds = divmod(START_NS + int(ms * MS), 1_000_000_000)
    return Message(stamp=Message(sec=seconds, nanosec=nanoseconds), frame_id=frame_id)


def arm_pose(ms: float) -> np.ndarray:
    """Return the pose of the tool: it moves evenly and turns evenly about z."""
    turn = Rotation.from_euler("z", 0.001 * ms).as_matrix()
    return transform_from(turn, [0.001 * ms, 0.5, 0.2])


BASE_FROM_SHOULDER = transform_from(np.eye(3), [0, 0, 0.16])
TOOL_FROM_CAMERA = transform_from(
    Rotation.from_euler("xyz", [0.3, 0.1, -0.2]).as_matrix(), [0.0, 0.05, 0.03]
)


def pictures(i: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(i)
    return (
        rng.integers(0, 256, (SIZE[1], SIZE[0], 3), dtype=np.uint8),
        rng.integers(300, 3000, (SIZE[1], SIZE[0]), dtype=np.uint16),
    )


def driven_bag(mount_ms: float = 150) -> Bag:
    """Return a bag of a moving arm: pose at 50 Hz for 0.2 s, static frames once, no pictures."""
    bag = Bag()
    bag.transform("/tf_static", mount_ms, "tool0", FRAME, TOOL_FROM_CAMERA)
    bag.transform("/tf_static", 0, "base_link", "shoulder", BASE_FROM_SHOULDER)
    for ms in np.arange(0, 201, 20.0):
        bag.transform("/tf", ms, "shoulder", "tool0", arm_pose(ms))
    return bag


def test_colour_pairs_with_the_nearest_depth(tmp_path):
    """Colour at 100 Hz, depth at 33 Hz and 3 ms late: a view per depth image."""
    bag = driven_bag()
    for i in range(10):
        bag.image(ROS2_TOPICS.color_image, 10 * i, pictures(i)[0], "rgb8")
        bag.info(ROS2_TOPICS.color_calibration, 10 * i)
    for i in (1, 4, 7):
        bag.image(ROS2_TOPICS.depth_image, 10 * i + 3, pictures(i)[1], "16UC1")
    recording = read_recording(bag.write(tmp_path / "run.mcap"))
    views = list(recording.views())

    assert recording.scan_id == "run"
    assert [view.index for view in views] == [0, 1, 2]
    for view, i in zip(views, (1, 4, 7), strict=True):
        color, millimetres = pictures(i)
        assert view.stamp_ns == START_NS + 10 * i * MS
        np.testing.assert_array_equal(view.color_rgb, color)
        np.testing.assert_array_equal(view.depth_m, millimetres / np.float32(1000))
        expected = BASE_FROM_SHOULDER @ arm_pose(10 * i) @ TOOL_FROM_CAMERA
        np.testing.assert_allclose(view.base_from_camera, expected, atol=1e-6)
        assert (view.intrinsics.fx_px, view.intrinsics.cy_px) == (50.0, 14.5)
    (warning,) = recording.warnings
    assert "run.mcap: 7 of 10 pictures on /camera/color/image_raw have no depth" in warning


@pytest.mark.parametrize(("late_ms", "views"), [(20, 1), (20.1, 0), (-20, 1), (-20.1, 0)])
def test_pairs_are_no_further_apart_than_stated(tmp_path, late_ms, views):
    bag = driven_bag()
    bag.image(ROS2_TOPICS.color_image, 50, pictures(0)[0], "rgb8")
    bag.info(ROS2_TOPICS.color_calibration, 50)
    bag.image(ROS2_TOPICS.depth_image, 50 + late_ms, pictures(0)[1], "16UC1")
    recording = read_recording(bag.write(tmp_path / "a.mcap"))
    assert recording.view_count == views
    if views == 0:
        with pytest.raises(RecordingError, match=r"none of 0 views is usable; .*no picture"):
            list(recording.views())
        wide = replace(ROS2_TOPICS, max_pair_gap_ns=30 * MS)
        assert read_recording(tmp_path / "a.mcap", wide).view_count == 1


def test_padding_byte_order_and_bgr_are_respected(tmp_path):
    color, millimetres = pictures(3)
    padded = np.zeros((SIZE[1], SIZE[0] + 5), ">u2")
    padded[:, : SIZE[0]] = millimetres
    bag = driven_bag()
    bag.image(ROS2_TOPICS.color_image, 20, np.ascontiguousarray(color[..., ::-1]), "bgr8")
    bag.info(ROS2_TOPICS.color_calibration, 20)
    bag.image(ROS2_TOPICS.depth_image, 20, padded, "16UC1", is_bigendian=1, width=SIZE[0])
    (view,) = read_recording(bag.write(tmp_path / "a.mcap")).views()
    np.testing.assert_array_equal(view.color_rgb, color)
    np.testing.assert_array_equal(view.depth_m, millimetres / np.float32(1000))


def test_compressed_pictures(tmp_path):
    color, millimetres = pictures(3)
    png = cv2.imencode(".png", color[..., ::-1])[1].tobytes()
    depth_png = struct.pack("<iff", 0, 0.0, 0.0) + cv2.imencode(".png", millimetres)[1].tobytes()
    bag = driven_bag()
    for topic, form, data in (
        (ROS2_TOPICS.color_image, "rgb8; png compressed bgr8", png),
        (ROS2_TOPICS.depth_image, "16UC1; compressedDepth png", depth_png),
    ):
        message = Message(header=header(20), format=form, data=data)
        bag.add(topic, "sensor_msgs/msg/CompressedImage", message, 25)
    bag.info(ROS2_TOPICS.color_calibration, 20)
    (view,) = read_recording(bag.write(tmp_path / "a.mcap")).views()
    np.testing.assert_array_equal(view.color_rgb, color)
    np.testing.assert_array_equal(view.depth_m, millimetres / np.float32(1000))


def test_instances_and_scores_of_a_segmenting_node(tmp_path):
    bag = driven_bag()
    ids = np.random.default_rng(0).integers(0, 3, SIZE[::-1], dtype=np.uint16)
    for i, ms in enumerate((20, 60, 100)):
        color, millimetres = pictures(i)
        bag.image(ROS2_TOPICS.color_image, ms, color, "rgb8")
        bag.info(ROS2_TOPICS.color_calibration, ms)
        bag.image(ROS2_TOPICS.depth_image, ms, millimetres, "16UC1")
        bag.image(ROS2_TOPICS.instances, ms, ids, "16UC1")
        if i != 1:
            scores = Message(data=f'{{"scores": [0.5, 0.{i}]}}')
            bag.add(ROS2_TOPICS.scores, "std_msgs/msg/String", scores, ms + 9)
    first, second, third = read_recording(bag.write(tmp_path / "a.mcap")).views()
    np.testing.assert_array_equal(first.instances, ids)
    assert (first.scores, third.scores) == ((0.5, 0.0), (0.5, 0.2))
    assert isinstance(second, RejectedView)
    assert "/camera/branches/scores: missing" in second.reason


def test_a_stereo_pair_and_nothing_else(tmp_path):
    bag = driven_bag()
    left, right = pictures(1)[0][..., 0].copy(), pictures(2)[0][..., 0].copy()
    bag.image(ROS2_TOPICS.left_image, 40, left, "mono8")
    bag.image(ROS2_TOPICS.right_image, 41, right, "mono8")
    bag.info(ROS2_TOPICS.left_calibration, 40)
    p = [*K[:3], -5.0, *K[3:6], 0.0, *K[6:], 0.0]
    bag.info(ROS2_TOPICS.right_calibration, 41, p=p)
    (view,) = read_recording(bag.write(tmp_path / "a.mcap")).views()
    np.testing.assert_array_equal(view.stereo.left_mono, left)
    np.testing.assert_array_equal(view.stereo.right_mono, right)
    assert view.stereo.baseline_m == pytest.approx(0.1)
    assert view.depth_m is None


def test_topics_of_another_camera_are_named_by_options(tmp_path):
    bag = driven_bag()
    color, millimetres = pictures(0)
    bag.image("/zed/rgb", 40, color, "rgb8")
    bag.info("/zed/info", 40)
    bag.image("/zed/depth", 40, (millimetres / 1000).astype(np.float32), "32FC1")
    path = bag.write(tmp_path / "a.mcap")
    with pytest.raises(
        RecordingError,
        match=r"needs /camera/color/image_raw .*it has .*/zed/depth \(sensor_msgs/msg/Image\)",
    ):
        read_recording(path)
    zed = replace(
        ROS2_TOPICS,
        color_image="/zed/rgb",
        color_calibration="/zed/info",
        depth_image="/zed/depth",
    )
    (view,) = read_recording(path, zed).views()
    np.testing.assert_allclose(view.depth_m, millimetres / 1000, atol=1e-6)


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"encoding": "bayer_rggb8"}, "encoding 'bayer_rggb8' is not one of"),
        ({"step": 7}, "40x30 rgb8 with 7 bytes per row does not fit"),
    ],
)
def test_pictures_that_cannot_be_understood(tmp_path, changes, text):
    bag = driven_bag()
    for i, ms in enumerate((20, 60)):
        color, millimetres = pictures(i)
        bag.image(ROS2_TOPICS.color_image, ms, color, "rgb8", **(changes if i else {}))
        bag.info(ROS2_TOPICS.color_calibration, ms)
        bag.image(ROS2_TOPICS.depth_image, ms, millimetres, "16UC1")
    good, bad = read_recording(bag.write(tmp_path / "a.mcap")).views()
    assert isinstance(good, View)
    assert bad.reason.startswith(f"view 1: {ROS2_TOPICS.color_image}: {text}")


@pytest.mark.parametrize(
    ("role", "indices_lost"),
    [("color_image", [1]), ("depth_image", [1]), ("color_calibration", [])],
)
def test_a_message_too_short_for_a_header_costs_its_view_at_most(tmp_path, role, indices_lost):
    bag = driven_bag()
    for i, ms in enumerate((20, 60, 100)):
        color, millimetres = pictures(i)
        bag.image(ROS2_TOPICS.color_image, ms, color, "rgb8")
        bag.info(ROS2_TOPICS.color_calibration, ms)
        bag.image(ROS2_TOPICS.depth_image, ms, millimetres, "16UC1")
    topic = getattr(ROS2_TOPICS, role)
    recording = read_recording(shortened(bag.write(tmp_path / "a.mcap"), topic, 1))
    views = list(recording.views())

    kept = [i for i in range(3) if i not in indices_lost]
    for view, i in zip(views, kept, strict=True):
        np.testing.assert_array_equal(view.color_rgb, pictures(i)[0])
        np.testing.assert_array_equal(view.depth_m, pictures(i)[1] / np.float32(1000))
    text = f"short.mcap: 1 of 3 messages on {topic} are too short for a header and are left out"
    assert text in recording.warnings[0]


def shortened(path, topic, place):
    """Copy a bag with one message of a topic cut to 3 bytes."""
    target = path.with_name("short.mcap")
    with path.open("rb") as source, target.open("wb") as stream:
        writer = McapWriter(stream)
        writer.start(profile="ros2")
        channels = {}
        seen = 0
        for schema, channel, message in make_reader(source).iter_messages():
            if channel.id not in channels:
                own = writer.register_schema(schema.name, schema.encoding, schema.data)
                channels[channel.id] = writer.register_channel(
                    channel.topic, channel.message_encoding, own
                )
            seen += channel.topic == topic
            short = channel.topic == topic and seen == place + 1
            writer.add_message(
                channels[channel.id],
                message.log_time,
                message.data[:3] if short else message.data,
                message.publish_time,
            )
        writer.finish()
    return target


def test_ros_recordings_are_cut_and_recovered_too(tmp_path):
    bag = driven_bag(mount_ms=0)
    for i, ms in enumerate((20, 60, 100)):
        color, millimetres = pictures(i)
        bag.image(ROS2_TOPICS.color_image, ms, color, "rgb8")
        bag.info(ROS2_TOPICS.color_calibration, ms)
        bag.image(ROS2_TOPICS.depth_image, ms, millimetres, "16UC1")
    path = bag.write(tmp_path / "a.mcap")
    whole = list(read_recording(path).views())

    cut_recording(path, tmp_path / "cut.mcap", [1])
    (only,) = read_recording(tmp_path / "cut.mcap").views()
    np.testing.assert_array_equal(only.color_rgb, whole[1].color_rgb)
    np.testing.assert_array_equal(only.base_from_camera, whole[1].base_from_camera)

    content = path.read_bytes()
    (tmp_path / "torn.mcap").write_bytes(content[: len(content) * 6 // 10])
    report = recover(tmp_path / "torn.mcap", tmp_path / "saved.mcap")
    saved = [v for v in read_recording(tmp_path / "saved.mcap").views() if isinstance(v, View)]
    assert 0 < report.views_saved == len(saved) < 3
    for view, before in zip(saved, whole, strict=False):
        np.testing.assert_array_equal(view.depth_m, before.depth_m)
