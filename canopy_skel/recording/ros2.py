"""ROS 2 messages (CDR): sensor_msgs Image, CompressedImage, CameraInfo, tf2_msgs TFMessage."""

import struct
from collections.abc import Mapping
from types import SimpleNamespace

from mcap.exceptions import McapError
from mcap.records import Schema
from mcap_ros2.decoder import DecoderFactory

from canopy_skel.calibration import Calibration, calibration_from_lists
from canopy_skel.messages import Picture, StampedTransform, decode_scores
from canopy_skel.pixels import Pixels, pixels_from_compressed, pixels_from_raw

_PNG = b"\x89PNG"


class Ros2Decoder:
    """Decodes CDR messages with the definitions that their recording carries."""

    def __init__(self, schemas: Mapping[str, Schema]) -> None:
        self._schemas = schemas
        self._factory = DecoderFactory()

    def picture(self, schema: str, data: bytes) -> Picture:
        """Decode sensor_msgs/msg/Image or sensor_msgs/msg/CompressedImage."""
        message = self._decode(schema, data, "Image", "CompressedImage")
        if hasattr(message, "format"):
            pixels = _compressed(bytes(message.data), message.format)
        else:
            pixels = pixels_from_raw(
                bytes(message.data),
                width_px=message.width,
                height_px=message.height,
                step=message.step,
                encoding=message.encoding,
                is_bigendian=bool(message.is_bigendian),
            )
        return Picture(
            stamp_ns=_stamp_ns(message.header), frame_id=message.header.frame_id, pixels=pixels
        )

    def calibration(self, schema: str, data: bytes) -> Calibration:
        """Decode sensor_msgs/msg/CameraInfo."""
        message = self._decode(schema, data, "CameraInfo")
        return calibration_from_lists(
            stamp_ns=_stamp_ns(message.header),
            frame_id=message.header.frame_id,
            size=(message.width, message.height),
            model=message.distortion_model,
            d=list(message.d),
            k=list(message.k),
            r=list(message.r),
            p=list(message.p),
        )

    def transforms(self, schema: str, data: bytes) -> tuple[StampedTransform, ...]:
        """Decode tf2_msgs/msg/TFMessage."""
        message = self._decode(schema, data, "TFMessage")
        return tuple(
            StampedTransform(
                stamp_ns=_stamp_ns(one.header),
                parent=one.header.frame_id,
                child=one.child_frame_id,
                translation_m=_xyz(one.transform.translation),
                quaternion_xyzw=(*_xyz(one.transform.rotation), one.transform.rotation.w),
            )
            for one in message.transforms
        )

    def scores(self, schema: str, data: bytes) -> tuple[float, ...]:
        """Decode std_msgs/msg/String that holds the JSON object {"scores": [s1, s2, …]}."""
        return decode_scores(self._decode(schema, data, "String").data)

    def _decode(self, schema: str, data: bytes, *wanted: str) -> SimpleNamespace:
        """Decode a message whose type name ends with one of `wanted`."""
        if schema.rsplit("/", 1)[-1] not in wanted:
            raise ValueError(f"holds {schema or 'no schema'}, not {' or '.join(wanted)}")
        try:
            decode = self._factory.decoder_for("cdr", self._schemas[schema])
            if decode is None:
                raise ValueError(f"has its schema as {self._schemas[schema].encoding}, not ros2msg")
            return decode(data)
        except (McapError, struct.error, IndexError, UnicodeDecodeError, EOFError) as error:
            raise ValueError(
                f"is not a {schema} (its {len(data)} bytes do not parse); check what writes this"
                " topic, and the disk"
            ) from error


def header_stamp_ns(data: bytes) -> int:
    """Return the stamp of a CDR message that begins with a std_msgs/msg/Header.

    Raises:
        ValueError: the message is too short.
    """
    if len(data) < 12:
        raise ValueError(f"is not a stamped message ({len(data)} bytes)")
    order = "<" if data[1] & 1 else ">"
    seconds, nanoseconds = struct.unpack_from(f"{order}iI", data, 4)
    return int(seconds) * 1_000_000_000 + int(nanoseconds)


def _compressed(data: bytes, picture_format: str) -> Pixels:
    """Decode a picture; depth of image_transport's compressedDepth has a header before the PNG."""
    if "compressedDepth" not in picture_format:
        return pixels_from_compressed(data, picture_format)
    start = data.find(_PNG, 0, 64)
    if start < 0 or not picture_format.startswith("16UC1"):
        raise ValueError(f"{picture_format!r} is not 16UC1 as png; record raw 16UC1 depth")
    return pixels_from_compressed(data[start:], picture_format)


def _stamp_ns(header: SimpleNamespace) -> int:
    return int(header.stamp.sec) * 1_000_000_000 + int(header.stamp.nanosec)


def _xyz(vector: SimpleNamespace) -> tuple[float, float, float]:
    return (vector.x, vector.y, vector.z)
