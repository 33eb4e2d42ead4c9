"""The topics of a scan and their messages: pure functions between bytes and arrays.

The bus and the recording carry these very bytes. Malformed bytes raise ValueError with a text that
says what is wrong; the caller knows which view and topic it was and says so.
"""

import json
import reprlib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Protocol, TypeVar, cast

from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.JointStates_pb2 import JointStates
from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from google.protobuf.descriptor import FileDescriptor
from google.protobuf.descriptor_pb2 import FileDescriptorSet
from google.protobuf.message import DecodeError
from google.protobuf.message import Message as Protobuf
from google.protobuf.timestamp_pb2 import Timestamp

from canopy_skel.calibration import Calibration, calibration_from_lists
from canopy_skel.pixels import Pixels, little_endian, pixels_from_compressed, pixels_from_raw

_P = TypeVar("_P", bound=Protobuf)

BASE_FRAME = "base"
TOOL_FRAME = "tool0"
CAMERA_FRAME = "camera_color_optical_frame"
JSON_SCHEMA = b'{"type":"object"}'
_MEND_SCORES = "write the confidence of each branch of the view"


@dataclass(frozen=True, kw_only=True, slots=True)
class Topic:
    """A row of the table: a topic, the name of its schema, and its protobuf class (None = JSON)."""

    name: str
    schema: str
    message_class: type[Protobuf] | None = None

    @property
    def message_encoding(self) -> str:
        """Encoding of the messages, as MCAP and the bus name it."""
        return "json" if self.message_class is None else "protobuf"

    @property
    def schema_encoding(self) -> str:
        """Encoding of the schema, as MCAP names it."""
        return "jsonschema" if self.message_class is None else "protobuf"

    def schema_data(self) -> bytes:
        """Return the bytes of the schema: a JSON schema or a serialised FileDescriptorSet."""
        if self.message_class is None:
            return JSON_SCHEMA
        return _descriptor_set(cast(FileDescriptor, self.message_class.DESCRIPTOR.file))


def _foxglove(name: str, message_class: type[Protobuf]) -> Topic:
    return Topic(name=name, schema=message_class.DESCRIPTOR.full_name, message_class=message_class)


COLOR_IMAGE = _foxglove("/camera/color/image", CompressedImage)
COLOR_CALIBRATION = _foxglove("/camera/color/calibration", CameraCalibration)
DEPTH_IMAGE = _foxglove("/camera/depth/image", RawImage)
LEFT_IMAGE = _foxglove("/camera/left/image", RawImage)
LEFT_CALIBRATION = _foxglove("/camera/left/calibration", CameraCalibration)
RIGHT_IMAGE = _foxglove("/camera/right/image", RawImage)
RIGHT_CALIBRATION = _foxglove("/camera/right/calibration", CameraCalibration)
TRANSFORMS = _foxglove("/tf", FrameTransforms)
JOINT_STATES = _foxglove("/robot/joint_states", JointStates)
TOOL_POSE = _foxglove("/robot/tool_pose", PoseInFrame)
INSTANCES = _foxglove("/camera/branches/instances", RawImage)
SCORES = Topic(name="/camera/branches/scores", schema="canopy.scores")
EVENT = Topic(name="/scan/event", schema="canopy.event")
SKELETON = _foxglove("/skeleton", SceneUpdate)

TOPICS: Mapping[str, Topic] = {
    topic.name: topic
    for topic in (
        COLOR_IMAGE,
        COLOR_CALIBRATION,
        DEPTH_IMAGE,
        LEFT_IMAGE,
        LEFT_CALIBRATION,
        RIGHT_IMAGE,
        RIGHT_CALIBRATION,
        TRANSFORMS,
        JOINT_STATES,
        TOOL_POSE,
        INSTANCES,
        SCORES,
        EVENT,
        SKELETON,
    )
}


@dataclass(frozen=True, kw_only=True, slots=True)
class Message:
    """One encoded message. sequence: index of the view it belongs to."""

    topic: str
    stamp_ns: int
    sequence: int
    data: bytes


@dataclass(frozen=True, kw_only=True, eq=False, slots=True)
class Picture:
    """A decoded image message; pixels (H, W) uint8 | uint16 | float32, or (H, W, 3) uint8 RGB."""

    stamp_ns: int
    frame_id: str
    pixels: Pixels


@dataclass(frozen=True, kw_only=True, slots=True)
class StampedTransform:
    """The pose of frame `child` in frame `parent` at one time; metres, quaternion (x, y, z, w)."""

    stamp_ns: int
    parent: str
    child: str
    translation_m: tuple[float, float, float]
    quaternion_xyzw: tuple[float, float, float, float]


class Decoder(Protocol):
    """Turns the bytes of a message into arrays; every method raises ValueError on bad bytes."""

    def picture(self, schema: str, data: bytes) -> Picture:
        """Decode a raw or compressed image."""
        ...

    def calibration(self, schema: str, data: bytes) -> Calibration:
        """Decode a camera calibration."""
        ...

    def transforms(self, schema: str, data: bytes) -> tuple[StampedTransform, ...]:
        """Decode a list of transforms."""
        ...

    def scores(self, schema: str, data: bytes) -> tuple[float, ...]:
        """Decode the confidences of the branch instances."""
        ...


class FoxgloveDecoder:
    """Decodes the Foxglove protobuf and JSON messages of the table above."""

    def picture(self, schema: str, data: bytes) -> Picture:
        """Decode foxglove.RawImage or foxglove.CompressedImage."""
        if schema == "foxglove.RawImage":
            raw = _parse(RawImage, data)
            pixels = pixels_from_raw(
                raw.data,
                width_px=raw.width,
                height_px=raw.height,
                step=raw.step,
                encoding=raw.encoding,
            )
            return Picture(
                stamp_ns=raw.timestamp.ToNanoseconds(), frame_id=raw.frame_id, pixels=pixels
            )
        if schema == "foxglove.CompressedImage":
            compressed = _parse(CompressedImage, data)
            pixels = pixels_from_compressed(compressed.data, compressed.format)
            return Picture(
                stamp_ns=compressed.timestamp.ToNanoseconds(),
                frame_id=compressed.frame_id,
                pixels=pixels,
            )
        raise ValueError(f"holds {schema}, not foxglove.RawImage or foxglove.CompressedImage")

    def calibration(self, schema: str, data: bytes) -> Calibration:
        """Decode foxglove.CameraCalibration."""
        _expect(schema, "foxglove.CameraCalibration")
        raw = _parse(CameraCalibration, data)
        return calibration_from_lists(
            stamp_ns=raw.timestamp.ToNanoseconds(),
            frame_id=raw.frame_id,
            size=(raw.width, raw.height),
            model=raw.distortion_model,
            d=raw.D,
            k=raw.K,
            r=raw.R,
            p=raw.P,
        )

    def transforms(self, schema: str, data: bytes) -> tuple[StampedTransform, ...]:
        """Decode foxglove.FrameTransforms."""
        _expect(schema, "foxglove.FrameTransforms")
        return tuple(
            StampedTransform(
                stamp_ns=one.timestamp.ToNanoseconds(),
                parent=one.parent_frame_id,
                child=one.child_frame_id,
                translation_m=(one.translation.x, one.translation.y, one.translation.z),
                quaternion_xyzw=(
                    one.rotation.x,
                    one.rotation.y,
                    one.rotation.z,
                    one.rotation.w,
                ),
            )
            for one in _parse(FrameTransforms, data).transforms
        )

    def scores(self, schema: str, data: bytes) -> tuple[float, ...]:
        """Decode the JSON object {"scores": [s1, s2, …]}."""
        return decode_scores(data)


def exposure_stamp_ns(picture: Message) -> int:
    """Return when a picture was taken: what its header says, else when it was recorded.

    Raises:
        ValueError: the bytes are no image message.
    """
    message_class = cast(type[CompressedImage | RawImage], TOPICS[picture.topic].message_class)
    return _parse(message_class, picture.data).timestamp.ToNanoseconds() or picture.stamp_ns


def decode_scores(data: bytes | str) -> tuple[float, ...]:
    """Return s1, s2, … of {"scores": [s1, s2, …]}.

    Raises:
        ValueError: not such an object, or a score outside [0, 1].
    """
    try:
        scores = json.loads(data)["scores"]
    except (ValueError, TypeError, KeyError, RecursionError):
        scores = None
    if not isinstance(scores, list):
        raise ValueError(f'is not a JSON object {{"scores": [0.9, …]}}; {_MEND_SCORES}')
    for number, score in enumerate(scores, start=1):
        if type(score) not in (int, float) or not 0 <= score <= 1:
            raise ValueError(
                f"score {number} is {reprlib.repr(score)}, not a number in 0…1; {_MEND_SCORES}"
            )
    return tuple(map(float, scores))


def encode_scores(scores: Iterable[float]) -> bytes:
    """Return the JSON message of the confidences of instances 1, 2, …."""
    return encode_json({"scores": list(scores)})


def encode_json(value: Mapping[str, object]) -> bytes:
    """Return compact JSON with sorted keys: the same value gives the same bytes."""
    return json.dumps(value, sort_keys=True, separators=(",", ":"), allow_nan=False).encode()


def encode_raw_image(pixels: Pixels, encoding: str, stamp_ns: int, frame_id: str) -> bytes:
    """Return a foxglove.RawImage, little endian and without padding, of (H, W) or (H, W, 3)."""
    little = little_endian(pixels, encoding)
    message = RawImage(
        timestamp=_timestamp(stamp_ns),
        frame_id=frame_id,
        width=pixels.shape[1],
        height=pixels.shape[0],
        encoding=encoding,
        step=little.strides[0],
        data=little.tobytes(),
    )
    return _serialize(message)


def encode_compressed_image(
    picture: bytes, picture_format: str, stamp_ns: int, frame_id: str
) -> bytes:
    """Return a foxglove.CompressedImage around an encoded picture ("jpeg", "png")."""
    timestamp = _timestamp(stamp_ns)
    return _serialize(
        CompressedImage(timestamp=timestamp, frame_id=frame_id, data=picture, format=picture_format)
    )


def encode_calibration(calibration: Calibration) -> bytes:
    """Return a foxglove.CameraCalibration."""
    message = CameraCalibration(
        timestamp=_timestamp(calibration.stamp_ns),
        frame_id=calibration.frame_id,
        width=calibration.width_px,
        height=calibration.height_px,
        distortion_model=calibration.distortion_model,
        D=calibration.d.tolist(),
        K=calibration.k.ravel().tolist(),
        R=calibration.r.ravel().tolist(),
        P=calibration.p.ravel().tolist(),
    )
    return _serialize(message)


def encode_transforms(transforms: Iterable[StampedTransform]) -> bytes:
    """Return a foxglove.FrameTransforms."""
    message = FrameTransforms()
    for transform in transforms:
        one = message.transforms.add(
            parent_frame_id=transform.parent, child_frame_id=transform.child
        )
        one.timestamp.FromNanoseconds(transform.stamp_ns)
        one.translation.x, one.translation.y, one.translation.z = transform.translation_m
        one.rotation.x, one.rotation.y, one.rotation.z, one.rotation.w = transform.quaternion_xyzw
    return _serialize(message)


def encode_pose(pose: StampedTransform) -> bytes:
    """Return a foxglove.PoseInFrame: where `child` is in `parent`."""
    message = PoseInFrame(frame_id=pose.parent)
    message.timestamp.FromNanoseconds(pose.stamp_ns)
    position, orientation = message.pose.position, message.pose.orientation
    position.x, position.y, position.z = pose.translation_m
    orientation.x, orientation.y, orientation.z, orientation.w = pose.quaternion_xyzw
    return _serialize(message)


def _parse(message_class: type[_P], data: bytes) -> _P:
    try:
        return message_class.FromString(data)
    except DecodeError as error:
        raise ValueError(
            f"is not a {message_class.DESCRIPTOR.full_name} (its {len(data)} bytes do not parse);"
            " check what writes this topic, and the disk"
        ) from error


def _expect(schema: str, wanted: str) -> None:
    if schema != wanted:
        raise ValueError(f"holds {schema or 'no schema'}, not {wanted}")


def _timestamp(stamp_ns: int) -> Timestamp:
    timestamp = Timestamp()
    timestamp.FromNanoseconds(stamp_ns)
    return timestamp


def _serialize(message: Protobuf) -> bytes:
    return message.SerializeToString(deterministic=True)


def _descriptor_set(file: FileDescriptor) -> bytes:
    """Serialise a descriptor with all it depends on, dependencies first."""
    files: dict[str, FileDescriptor] = {}

    def visit(one: FileDescriptor) -> None:
        if one.name not in files:
            for dependency in one.dependencies:
                visit(dependency)
            files[one.name] = one

    visit(file)
    descriptors = FileDescriptorSet()
    for one in files.values():
        one.CopyToProto(descriptors.file.add())
    return descriptors.SerializeToString(deterministic=True)
