"""Recordings as views: grouped, posed, undistorted, one at a time."""

from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

from canopy_skel.document import RejectedView
from canopy_skel.errors import RecordingError, ViewError
from canopy_skel.frame import View
from canopy_skel.messages import Decoder, FoxgloveDecoder, StampedTransform
from canopy_skel.recording.decode import Part, decode_view
from canopy_skel.recording.grouping import (
    Group,
    RefsByRole,
    group_by_sequence,
    mark_cut_off,
    pair_by_stamp,
    refs_by_role,
)
from canopy_skel.recording.mcap_file import (
    AttachmentRef,
    McapFile,
    MessageReader,
    MessageRef,
    scan_mcap,
)
from canopy_skel.recording.options import (
    CALIBRATION_ROLES,
    PICTURE_ROLES,
    ROS2_TOPICS,
    TopicOptions,
)
from canopy_skel.recording.ros2 import Ros2Decoder, header_stamp_ns
from canopy_skel.recording.transforms import TransformBuffer

METADATA_RECORD = "canopy"
RECOVERY_RECORD = "canopy_recovery"
GROUND_TRUTH = "ground_truth_skeleton.json"
_TOPICS_IN_A_LINE = 20
_CAMERA_SCHEMAS = ("Image", "RawImage", "CompressedImage", "CameraInfo", "CameraCalibration")


@dataclass(frozen=True, kw_only=True, slots=True)
class TopicSummary:
    """A topic of a file: its schema, its message encoding, how many messages."""

    topic: str
    schema: str
    encoding: str
    messages: int


@dataclass(frozen=True, kw_only=True, eq=False, slots=True)
class Recording:
    """A recording that was looked through once; views are decoded when they are iterated.

    view_count: views found, unusable ones included. warnings: one line each, about truncation,
    damage and unpaired pictures.
    """

    path: Path
    scan_id: str
    metadata: Mapping[str, str]
    topics: tuple[TopicSummary, ...]
    attachments: tuple[AttachmentRef, ...]
    warnings: tuple[str, ...]
    options: TopicOptions
    file: McapFile
    groups: tuple[Group, ...]
    transforms: TransformBuffer

    @property
    def view_count(self) -> int:
        """How many views the file holds, unusable ones included."""
        return len(self.groups)

    @property
    def incomplete_views(self) -> tuple[int, ...]:
        """Indices of views of which the file has lost a part."""
        return tuple(group.index for group in self.groups if group.partial)

    @property
    def ground_truth(self) -> bytes | None:
        """The attached true skeleton document (simulated recordings), None if there is none."""
        return self.attachment(GROUND_TRUTH)

    def attachment(self, name: str) -> bytes | None:
        """Return the data of the first attachment with this name, None if there is none."""
        for ref in self.attachments:
            if ref.name == name:
                return self.file.attachment(ref)
        return None

    def views(self) -> Iterator[View | RejectedView]:
        """Yield the views in ascending index order, decoded one by one.

        A view that cannot be used is yielded as a RejectedView with its reason; the others are not
        affected.

        Raises:
            RecordingError: after the last one, if none of them was usable.
        """
        reader = MessageReader(self.file)
        decoders = decoders_of(self.file)
        rejected: list[str] = []
        for group in self.groups:
            try:
                found: View | RejectedView = self._decode(group, reader, decoders)
            except ViewError as error:
                rejected.append(str(error))
                found = RejectedView(index=group.index, reason=str(error))
            yield found
        if len(rejected) == len(self.groups):
            first = rejected[0] if rejected else "it holds no picture at all"
            raise RecordingError(
                f"{self.path}: none of {len(self.groups)} views is usable; the first: {first}"
            )

    def view(self, index: int) -> View | RejectedView:
        """Return the view with this index alone; see `views`.

        Raises:
            RecordingError: there is no such view, or the file has changed since it was looked
                through.
        """
        for group in self.groups:
            if group.index == index:
                try:
                    return self._decode(group, MessageReader(self.file), decoders_of(self.file))
                except ViewError as error:
                    return RejectedView(index=index, reason=str(error))
        raise RecordingError(f"{self.path}: no view {index}; it has {self.view_count} views")

    def _decode(self, group: Group, reader: MessageReader, decoders: Mapping[str, Decoder]) -> View:
        if group.flaw is not None:
            raise ViewError(group.flaw)
        return decode_view(
            group.index,
            {role: _part(self.file, ref, reader) for role, ref in group.refs.items()},
            transforms=self.transforms,
            options=self.options,
            decoders=decoders,
        )


def read_recording(path: str | Path, topics: TopicOptions | None = None) -> Recording:
    """Look through a recording (canopy / Foxglove protobuf, or ROS 2), truncated ones included.

    Args:
        path: an MCAP file.
        topics: names of topics and frames; by default those of a canopy recording, or
            ROS2_TOPICS if the file says that ROS 2 wrote it.

    Raises:
        RecordingError: the file cannot be read, or has no camera topic or calibration to use.
    """
    file = scan_mcap(Path(path))
    options = topics or (ROS2_TOPICS if file.profile == "ros2" else TopicOptions())
    by_role = refs_by_role(file, options)
    _require_cameras(file, by_role, options)
    reader = MessageReader(file)
    warnings = list(_damage_warnings(file))
    groups = _groups(file, by_role, options, reader, warnings)
    transforms = _transforms(file, by_role, options, reader, warnings)
    metadata = _metadata(file, METADATA_RECORD)
    return Recording(
        path=file.path,
        scan_id=metadata.get("scan_id") or file.path.stem,
        metadata=metadata,
        topics=summarise_topics(file),
        attachments=tuple(file.attachments),
        warnings=tuple(warnings),
        options=options,
        file=file,
        groups=tuple(groups),
        transforms=transforms,
    )


def summarise_topics(file: McapFile) -> tuple[TopicSummary, ...]:
    """Return the topics of a file by name."""
    counts = dict.fromkeys(file.channels, 0)
    for ref in file.messages:
        if ref.channel_id in counts:
            counts[ref.channel_id] += 1
    summaries = [
        TopicSummary(
            topic=channel.topic,
            schema=file.schema_of(channel.id).name,
            encoding=channel.message_encoding,
            messages=counts[channel.id],
        )
        for channel in file.channels.values()
    ]
    return tuple(sorted(summaries, key=lambda one: one.topic))


def decoders_of(file: McapFile) -> dict[str, Decoder]:
    """Return the decoders by message encoding."""
    foxglove = FoxgloveDecoder()
    ros2 = Ros2Decoder({schema.name: schema for schema in file.schemas.values()})
    return {"protobuf": foxglove, "json": foxglove, "cdr": ros2}


def _require_cameras(file: McapFile, by_role: RefsByRole, options: TopicOptions) -> None:
    pair = "left_image" in by_role and "right_image" in by_role
    side = "color" if "color_image" in by_role else "left"
    cut = f" (it is cut off at byte {file.cut_at})" if file.cut_at is not None else ""
    cameras = pair or {"color_image", "depth_image"} <= set(by_role)
    calibrated = f"{side}_calibration" in by_role
    if not (cameras and calibrated) and _ends_in_first_view(file, by_role, options):
        raise RecordingError(
            f"{file.path}: ends before its first whole view (readable up to byte {file.cut_at} of"
            f" {file.size}); no view can be recovered from it, record it again"
        )
    if not cameras:
        raise RecordingError(
            f"{file.path}: no usable camera topic{cut}: needs {options.color_image} with"
            f" {options.depth_image}, or {options.left_image} with {options.right_image};"
            f" it has {_topic_list(file)}; name its topics in the topic options"
        )
    if not calibrated:
        topic = getattr(options, f"{side}_calibration")
        raise RecordingError(
            f"{file.path}: no camera calibration on {topic}{cut}: record it once before the first"
            f" view, or name its topic; it has {_topic_list(file)}"
        )


def _ends_in_first_view(file: McapFile, by_role: RefsByRole, options: TopicOptions) -> bool:
    """Say whether it is for being cut off, not for other names of topics, that no view is whole."""
    unnamed = any(
        one.schema.replace("/", ".").rsplit(".")[-1] in _CAMERA_SCHEMAS
        and options.role_of(one.topic) is None
        for one in summarise_topics(file)
    )
    exposures = max((len(by_role.get(role, ())) for role in PICTURE_ROLES), default=0)
    return file.cut_at is not None and not unnamed and exposures <= 1


def _topic_list(file: McapFile) -> str:
    summaries = summarise_topics(file)
    named = [f"{one.topic} ({one.schema or one.encoding})" for one in summaries]
    more = len(named) - _TOPICS_IN_A_LINE
    rest = f" and {more} more" if more > 0 else ""
    return (", ".join(named[:_TOPICS_IN_A_LINE]) or "no topic at all") + rest


def _groups(
    file: McapFile,
    by_role: RefsByRole,
    options: TopicOptions,
    reader: MessageReader,
    warnings: list[str],
) -> list[Group]:
    main = "color_image" if "color_image" in by_role else "left_image"
    if file.channels[by_role[main][0].channel_id].message_encoding == "cdr":
        groups, alone = _pair_ros2(file, by_role, options, reader, warnings)
        if alone:
            warnings.append(
                f"{file.path.name}: {alone} of {alone + len(groups)} pictures on"
                f" {getattr(options, main)} have no depth or stereo partner within"
                f" {options.max_pair_gap_ns / 1e6:.0f} ms and are left out"
            )
    else:
        groups = group_by_sequence(by_role)
    last = max(groups, key=_last_place, default=None)
    suspects = groups if file.damage else [last] if last and file.cut_at is not None else []
    lost = _metadata(file, RECOVERY_RECORD).get("incomplete_views", "").split(",")
    suspects = [*suspects, *(group for group in groups if str(group.index) in lost)]
    mark_cut_off(groups, suspects, options)
    if file.cut_at is not None:
        saved = sum(group.flaw is None for group in groups)
        warnings.append(
            f"{file.path.name}: cut off at byte {file.cut_at} of {file.size}: {saved} whole views"
            " were saved; `canopy recover` makes a whole file of them"
        )
    return groups


def _pair_ros2(
    file: McapFile,
    by_role: RefsByRole,
    options: TopicOptions,
    reader: MessageReader,
    warnings: list[str],
) -> tuple[list[Group], int]:
    stamps: dict[MessageRef, int] = {}
    stamped = dict(by_role)
    for role in (*PICTURE_ROLES, *CALIBRATION_ROLES):
        refs = by_role.get(role, [])
        for ref in refs:
            with suppress(ValueError):
                stamps[ref] = header_stamp_ns(reader.read(ref)) or ref.log_time_ns
        stamped[role] = [ref for ref in refs if ref in stamps]
        if len(stamped[role]) < len(refs):
            warnings.append(
                f"{file.path.name}: {len(refs) - len(stamped[role])} of {len(refs)} messages on"
                f" {getattr(options, role)} are too short for a header and are left out; check what"
                " writes this topic, and the disk"
            )
    return pair_by_stamp(stamped, stamps.__getitem__, options.max_pair_gap_ns)


def _last_place(group: Group) -> tuple[int, int]:
    return max((ref.chunk_offset or ref.offset, ref.offset) for ref in group.refs.values())


def _transforms(
    file: McapFile,
    by_role: RefsByRole,
    options: TopicOptions,
    reader: MessageReader,
    warnings: list[str],
) -> TransformBuffer:
    decoders = decoders_of(file)
    found: dict[str, list[StampedTransform]] = {"transforms": [], "static_transforms": []}
    for role, transforms in found.items():
        for ref in by_role.get(role, ()):
            part = _part(file, ref, reader)
            try:
                decoded = decoders[part.encoding].transforms(part.schema, part.data)
            except (ValueError, KeyError) as error:
                warnings.append(f"{file.path.name}: {part.topic}: a message is left out: {error}")
                continue
            transforms.extend(
                one if one.stamp_ns else replace(one, stamp_ns=ref.log_time_ns) for one in decoded
            )
    return TransformBuffer(
        found["transforms"],
        found["static_transforms"],
        tool_frame=options.tool_frame,
        max_gap_ns=options.max_pose_gap_ns,
    )


def _part(file: McapFile, ref: MessageRef, reader: MessageReader) -> Part:
    channel = file.channels[ref.channel_id]
    return Part(
        topic=channel.topic,
        schema=file.schema_of(channel.id).name,
        encoding=channel.message_encoding,
        log_time_ns=ref.log_time_ns,
        data=reader.read(ref),
    )


def metadata_of(path: Path) -> dict[str, str]:
    """Return what a recording says of its scan, also one without views; nothing if it says nothing.

    Raises:
        RecordingError: the file cannot be read.
    """
    return _metadata(scan_mcap(path), METADATA_RECORD)


def _metadata(file: McapFile, name: str) -> dict[str, str]:
    for record in file.metadata:
        if record.name == name:
            return dict(record.metadata)
    return {}


def _damage_warnings(file: McapFile) -> Iterator[str]:
    for line in file.damage:
        yield f"{file.path.name}: {line}; what it held is left out"
