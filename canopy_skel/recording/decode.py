"""From the messages of one exposure to a View of a pinhole camera."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from canopy_skel.errors import ViewError
from canopy_skel.frame import Float32Array, StereoPair, UInt16Array, View
from canopy_skel.geometry import FloatArray, transform_from
from canopy_skel.messages import (
    TOPICS,
    Decoder,
    FoxgloveDecoder,
    Message,
    Picture,
    StampedTransform,
)
from canopy_skel.pixels import as_depth_m, as_instances, as_mono, as_rgb
from canopy_skel.recording.options import TopicOptions
from canopy_skel.recording.rectify import Rectification, rectification
from canopy_skel.recording.transforms import TransformBuffer

_Side = Literal["color", "left", "right"]
_PAIR_ROLES = ("left_image", "right_image", "left_calibration", "right_calibration")
_SAME_CAMERA_PX = 0.05
_CANOPY_TOPICS = TopicOptions()


@dataclass(frozen=True, kw_only=True, slots=True)
class Part:
    """One encoded message of an exposure; `log_time_ns` stands in for a stamp of zero."""

    topic: str
    schema: str
    encoding: str
    log_time_ns: int
    data: bytes


def decode_view(
    index: int,
    parts: Mapping[str, Part],
    *,
    transforms: TransformBuffer,
    options: TopicOptions,
    decoders: Mapping[str, Decoder],
) -> View:
    """Return the view of one exposure: undistorted and, where it is a pair, rectified.

    A pair beside a depth image is kept only if it is calibrated and its left camera is the colour
    camera: the depth image needs no pair.

    Args:
        index: place in the scan.
        parts: messages by role (the names of the topic fields of TopicOptions).
        transforms: the poses of the scan.
        options: names of topics and frames.
        decoders: by message encoding ("protobuf", "json", "cdr").

    Raises:
        ViewError: something is missing or wrong; the text names view, topic and mend.
    """
    return _Exposure(index, parts, transforms, options, decoders).view()


def view_from_messages(messages: Sequence[Message], options: TopicOptions = _CANOPY_TOPICS) -> View:
    """Return the view that the messages of one exposure hold, without the rest of the recording.

    It is the View that `read_recording` gives for these messages, as long as they carry their own
    calibration, pose and hand-eye transform (RecordingWriter.write_view takes care of that) and no
    two views of the scan have the same stamp.

    Args:
        messages: all of one view, as RecordingWriter.write_view or messages_of_view returned them.
        options: names of topics and frames.

    Raises:
        ViewError: something is missing or wrong; the text names view, topic and mend.
    """
    indices = sorted({message.sequence for message in messages})
    if len(indices) != 1:
        raise ViewError(
            f"the messages are of views {indices}, not of one view; give those of one `sequence`"
        )
    parts: dict[str, Part] = {}
    transforms: list[StampedTransform] = []
    decoder = FoxgloveDecoder()
    for message in messages:
        role = options.role_of(message.topic)
        if role is None or message.topic not in TOPICS:
            continue
        if role == "transforms":
            transforms.extend(stamped_transforms(message))
        else:
            parts.setdefault(role, _part(message))
    return decode_view(
        indices[0],
        parts,
        transforms=TransformBuffer(
            transforms, tool_frame=options.tool_frame, max_gap_ns=options.max_pose_gap_ns
        ),
        options=options,
        decoders={"protobuf": decoder, "json": decoder},
    )


def _part(message: Message) -> Part:
    topic = TOPICS[message.topic]
    return Part(
        topic=topic.name,
        schema=topic.schema,
        encoding=topic.message_encoding,
        log_time_ns=message.stamp_ns,
        data=message.data,
    )


def stamped_transforms(message: Message) -> list[StampedTransform]:
    """Return the transforms of a message; none of bytes that are no message, as readers do."""
    try:
        decoded = FoxgloveDecoder().transforms(TOPICS[message.topic].schema, message.data)
    except ValueError:
        return []  # the pose is looked up next, and missed by name
    return [one if one.stamp_ns else replace(one, stamp_ns=message.stamp_ns) for one in decoded]


@dataclass(frozen=True, slots=True)
class _Exposure:
    index: int
    parts: Mapping[str, Part]
    transforms: TransformBuffer
    options: TopicOptions
    decoders: Mapping[str, Decoder]

    def view(self) -> View:
        grey_only = "color_image" not in self.parts and "left_image" in self.parts
        side: _Side = "left" if grey_only else "color"
        picture = self._picture(f"{side}_image")
        lens = self._lens(side)
        stamp_ns = picture.stamp_ns or self.parts[f"{side}_image"].log_time_ns
        with self._blame(f"{side}_image"):
            color_rgb = as_rgb(lens.apply(picture.pixels, "colour"))
        depth_m = self._depth(lens, stamp_ns)
        stereo = self._stereo(side, picture.frame_id, lens, stamp_ns, needed=depth_m is None)
        instances, scores = self._instances(lens, stamp_ns)
        return View(
            index=self.index,
            stamp_ns=stamp_ns,
            color_rgb=color_rgb,
            intrinsics=lens.intrinsics,
            base_from_camera=self._pose(side, picture.frame_id, lens, stamp_ns),
            depth_m=depth_m,
            stereo=stereo,
            instances=instances,
            scores=scores,
        )

    def _depth(self, lens: Rectification, stamp_ns: int) -> Float32Array | None:
        if "depth_image" not in self.parts:
            return None
        picture = self._picture("depth_image", stamp_ns)
        with self._blame("depth_image"):
            return lens.apply(as_depth_m(picture.pixels), "depth")

    def _instances(
        self, lens: Rectification, stamp_ns: int
    ) -> tuple[UInt16Array | None, tuple[float, ...] | None]:
        """Return branch ids and their scores: both, or none of them."""
        there = [role for role in ("instances", "scores") if role in self.parts]
        if not there:
            return None, None
        if len(there) == 1:
            missing = "scores" if there == ["instances"] else "instances"
            raise self._error(
                missing, f"missing, but {self._topic(there[0])} is there; record both"
            )
        picture = self._picture("instances", stamp_ns)
        with self._blame("instances"):
            instances = lens.apply(as_instances(picture.pixels), "labels")
        part = self.parts["scores"]
        with self._blame("scores"):
            scores = self._decoder(part).scores(part.schema, part.data)
            if instances.max() > len(scores):
                raise ValueError(
                    f"holds {len(scores)} scores but {self._topic('instances')} has instance"
                    f" {instances.max()}; give one score per instance"
                )
        return instances, scores

    def _stereo(
        self, side: _Side, frame_id: str, lens: Rectification, stamp_ns: int, *, needed: bool
    ) -> StereoPair | None:
        if not needed and not all(role in self.parts for role in _PAIR_ROLES):
            return None
        if "left_image" not in self.parts and "right_image" not in self.parts:
            raise self._error(
                "depth_image",
                "missing, and there is no stereo pair either; record one of them with every view",
            )
        left_picture = self._picture("left_image", stamp_ns)
        right_picture = self._picture("right_image", stamp_ns)
        left, right = self._lens("left"), self._lens("right")
        if side == "color" and not (left_picture.frame_id == frame_id and _same(left, lens)):
            if not needed:
                return None
            raise self._error(
                "left_image",
                f"is of another camera than {self._topic('color_image')} and there is no depth"
                " image; record depth aligned to colour, or the left picture as colour",
            )
        with self._blame("right_calibration"):
            _check_pair(left, right)
        with self._blame("left_image"):
            left_mono = as_mono(left.apply(left_picture.pixels, "colour"))
        with self._blame("right_image"):
            right_mono = as_mono(right.apply(right_picture.pixels, "colour"))
        return StereoPair(
            left_mono=left_mono,
            right_mono=right_mono,
            intrinsics=left.intrinsics,
            baseline_m=right.baseline_m,
        )

    def _pose(self, side: _Side, frame_id: str, lens: Rectification, stamp_ns: int) -> FloatArray:
        with self._blame("transforms"):
            if not frame_id:
                raise ValueError(f"cannot place {self._topic(f'{side}_image')}: no frame_id in it")
            base_from_lens = self.transforms.lookup(self.options.base_frame, frame_id, stamp_ns)
        return base_from_lens @ transform_from(lens.camera_from_pinhole, np.zeros(3))

    def _picture(self, role: str, stamp_ns: int | None = None) -> Picture:
        """Decode a picture that must be there, and taken at `stamp_ns` if that is given."""
        part = self._part(role)
        with self._blame(role):
            picture = self._decoder(part).picture(part.schema, part.data)
            gap_ns = 0 if stamp_ns is None else (picture.stamp_ns or part.log_time_ns) - stamp_ns
            if abs(gap_ns) > self.options.max_pair_gap_ns:
                raise ValueError(
                    f"was taken {gap_ns / 1e6:+.1f} ms from the colour image (limit"
                    f" {self.options.max_pair_gap_ns / 1e6:.0f} ms); give the pictures of one"
                    " exposure the same timestamp"
                )
        return picture

    def _lens(self, side: _Side) -> Rectification:
        role = f"{side}_calibration"
        part = self._part(role)
        with self._blame(role):
            calibration = self._decoder(part).calibration(part.schema, part.data)
            return rectification(calibration, self.options.rectified)

    def _part(self, role: str) -> Part:
        if role not in self.parts:
            raise self._error(role, "missing; record it with every view (calibrations: or before)")
        return self.parts[role]

    def _decoder(self, part: Part) -> Decoder:
        if part.encoding not in self.decoders:
            raise ValueError(f"is encoded as {part.encoding!r}, not {' or '.join(self.decoders)}")
        return self.decoders[part.encoding]

    def _topic(self, role: str) -> str:
        return str(getattr(self.options, role))

    def _error(self, role: str, text: str) -> ViewError:
        return ViewError(f"view {self.index}: {self._topic(role)}: {text}")

    @contextmanager
    def _blame(self, role: str) -> Iterator[None]:
        """Name view and topic in whatever is wrong inside."""
        try:
            yield
        except ValueError as error:
            raise self._error(role, str(error)) from error


def _same(one: Rectification, other: Rectification) -> bool:
    return bool(
        np.allclose(_pinhole(one), _pinhole(other), rtol=0, atol=_SAME_CAMERA_PX)
        and np.allclose(one.camera_from_pinhole, other.camera_from_pinhole, atol=1e-6)
    )


def _check_pair(left: Rectification, right: Rectification) -> None:
    """Say why two cameras are not a rectified pair."""
    if not np.allclose(_pinhole(left), _pinhole(right), rtol=0, atol=_SAME_CAMERA_PX):
        raise ValueError(
            "left and right differ in K or size; give the R and P of the rectification"
        )
    if not 0 < right.baseline_m < np.inf:
        raise ValueError("P carries no baseline; P[3] of the right camera is -fx * baseline")


def _pinhole(lens: Rectification) -> list[float]:
    i = lens.intrinsics
    return [i.fx_px, i.fy_px, i.cx_px, i.cy_px, i.width_px, i.height_px]
