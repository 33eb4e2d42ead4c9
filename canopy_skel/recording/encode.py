"""From a View to the messages of one exposure."""

from dataclasses import dataclass

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from canopy_skel.calibration import Calibration
from canopy_skel.errors import ViewError
from canopy_skel.frame import Intrinsics, StereoPair, UInt8Array, View
from canopy_skel.geometry import FloatArray, invert
from canopy_skel.messages import (
    BASE_FRAME,
    CAMERA_FRAME,
    COLOR_CALIBRATION,
    COLOR_IMAGE,
    DEPTH_IMAGE,
    INSTANCES,
    LEFT_CALIBRATION,
    LEFT_IMAGE,
    RIGHT_CALIBRATION,
    RIGHT_IMAGE,
    SCORES,
    TOOL_FRAME,
    TRANSFORMS,
    Message,
    StampedTransform,
    Topic,
    encode_calibration,
    encode_compressed_image,
    encode_raw_image,
    encode_scores,
    encode_transforms,
)
from canopy_skel.pixels import depth_to_millimetres

_JPEG_QUALITY = 95


@dataclass(frozen=True, kw_only=True, slots=True)
class EncodedPicture:
    """A picture as a camera delivered it; format is "jpeg" or "png"."""

    data: bytes
    format: str


def encode_view(
    view: View, tool_from_camera: FloatArray, color: EncodedPicture | None = None
) -> tuple[Message, ...]:
    """Return the messages of one view; the same view gives the same bytes.

    Every view carries its own calibration and hand-eye transform, so that it can be understood
    alone. Depth is rounded to millimetres.

    Args:
        view: what to encode.
        tool_from_camera: (4, 4), the hand-eye calibration.
        color: the colour picture already encoded, kept unchanged; jpeg of quality 95 by default.
    """
    color = color or encode_jpeg(view)
    lens = view.intrinsics
    parts: list[tuple[Topic, bytes]] = [
        (TRANSFORMS, _transforms(view, tool_from_camera)),
        (COLOR_IMAGE, encode_compressed_image(color.data, color.format, *_origin(view))),
        (COLOR_CALIBRATION, encode_calibration(_calibration(view, lens))),
    ]
    if view.depth_m is not None:
        millimetres = depth_to_millimetres(view.depth_m)
        parts.append((DEPTH_IMAGE, encode_raw_image(millimetres, "16UC1", *_origin(view))))
    if view.stereo is not None:
        parts.extend(_stereo(view, view.stereo))
    if view.instances is not None:
        parts.append((INSTANCES, encode_raw_image(view.instances, "16UC1", *_origin(view))))
    if view.scores is not None:
        parts.append((SCORES, encode_scores(view.scores)))
    return tuple(
        Message(topic=topic.name, stamp_ns=view.stamp_ns, sequence=view.index, data=data)
        for topic, data in parts
    )


def encode_jpeg(view: View) -> EncodedPicture:
    """Return the colour picture of a view as jpeg of quality 95."""
    bgr: UInt8Array = np.ascontiguousarray(view.color_rgb[..., ::-1])
    done, data = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])
    if not done:
        raise ViewError(f"view {view.index}: the colour picture cannot be encoded as jpeg")
    return EncodedPicture(data=data.tobytes(), format="jpeg")


def _origin(view: View) -> tuple[int, str]:
    return view.stamp_ns, CAMERA_FRAME


def _transforms(view: View, tool_from_camera: FloatArray) -> bytes:
    base_from_tool = view.base_from_camera @ invert(tool_from_camera)
    return encode_transforms(
        (
            stamped_transform(view.stamp_ns, TOOL_FRAME, CAMERA_FRAME, tool_from_camera),
            stamped_transform(view.stamp_ns, BASE_FRAME, TOOL_FRAME, base_from_tool),
        )
    )


def stamped_transform(
    stamp_ns: int, parent: str, child: str, parent_from_child: FloatArray
) -> StampedTransform:
    """Return the pose of frame `child` in frame `parent`, which the (4, 4) matrix is."""
    x, y, z, w = Rotation.from_matrix(parent_from_child[:3, :3]).as_quat(canonical=True)
    return StampedTransform(
        stamp_ns=stamp_ns,
        parent=parent,
        child=child,
        translation_m=tuple(parent_from_child[:3, 3].tolist()),
        quaternion_xyzw=(float(x), float(y), float(z), float(w)),
    )


def _stereo(view: View, pair: StereoPair) -> list[tuple[Topic, bytes]]:
    left = _calibration(view, pair.intrinsics)
    right = _calibration(view, pair.intrinsics, baseline_m=pair.baseline_m)
    return [
        (LEFT_IMAGE, encode_raw_image(pair.left_mono, "mono8", *_origin(view))),
        (LEFT_CALIBRATION, encode_calibration(left)),
        (RIGHT_IMAGE, encode_raw_image(pair.right_mono, "mono8", *_origin(view))),
        (RIGHT_CALIBRATION, encode_calibration(right)),
    ]


def _calibration(view: View, lens: Intrinsics, baseline_m: float = 0.0) -> Calibration:
    k = np.array([[lens.fx_px, 0, lens.cx_px], [0, lens.fy_px, lens.cy_px], [0, 0, 1.0]])
    offset_px = -lens.fx_px * baseline_m
    return Calibration(
        stamp_ns=view.stamp_ns,
        frame_id=CAMERA_FRAME,
        width_px=lens.width_px,
        height_px=lens.height_px,
        distortion_model="plumb_bob",
        d=np.zeros(5),
        k=k,
        r=np.eye(3),
        p=np.column_stack([k, [offset_px, 0.0, 0.0]]),
    )
