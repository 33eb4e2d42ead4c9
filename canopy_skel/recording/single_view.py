"""One view of a recording as messages that stand alone: what is sent on, byte for byte."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

from canopy_skel.errors import UsageError
from canopy_skel.messages import (
    TOPICS,
    TRANSFORMS,
    Message,
    encode_transforms,
    exposure_stamp_ns,
)
from canopy_skel.recording.decode import stamped_transforms
from canopy_skel.recording.grouping import Group
from canopy_skel.recording.mcap_file import MessageReader, MessageRef
from canopy_skel.recording.options import TopicOptions
from canopy_skel.recording.reader import Recording


def messages_of_view(recording: Recording, index: int) -> tuple[Message, ...]:
    """Return the messages of one view, in the order and with the bytes they were recorded with.

    A calibration or transforms that the recording keeps apart from the view, such as a hand-eye
    transform said once at its beginning, come after them: with all these the view stands alone.

    The file may be a `.part` that is still being written: what was complete when read_recording
    looked through it is found; nothing is locked or changed.

    Raises:
        UsageError: there was no view with this index then, or it was lost in part.
        RecordingError: the file has changed or vanished since it was looked through.
    """
    group = next((one for one in recording.groups if one.index == index), None)
    if group is None or group.partial:
        has = ", ".join(str(one.index) for one in recording.groups if not one.partial)
        raise UsageError(f"{recording.path}: no whole view {index}; it has {has or 'none'}")
    file, reader = recording.file, MessageReader(recording.file)
    names = {one.id: one.topic for one in file.channels.values()}
    own = [
        _message(ref, names, reader)
        for ref in file.messages
        if ref.sequence == index and _belongs_to_views(names.get(ref.channel_id), recording.options)
    ]
    apart = [
        replace(_message(ref, names, reader), sequence=index)
        for ref in _calibrations(group)
        if ref.sequence != index
    ]
    return (*own, *apart, *_transforms_apart(recording, own, index))


def _calibrations(group: Group) -> list[MessageRef]:
    """Return the calibrations of those cameras that the view has a picture of."""
    refs, cameras = group.refs, ("color", "left", "right")
    there = [f"{camera}_calibration" for camera in cameras if f"{camera}_image" in refs]
    return [refs[role] for role in there if role in refs]


def _message(ref: MessageRef, names: Mapping[int, str], reader: MessageReader) -> Message:
    return Message(
        topic=names[ref.channel_id],
        stamp_ns=ref.log_time_ns,
        sequence=ref.sequence,
        data=reader.read(ref),
    )


def _transforms_apart(recording: Recording, own: Sequence[Message], index: int) -> list[Message]:
    """Return what the messages of a view lack of the transforms at its exposure, as one message."""
    options = recording.options
    by_role = {options.role_of(one.topic): one for one in reversed(own)}
    picture = by_role.get("color_image") or by_role.get("left_image")
    if picture is None:
        return []
    try:
        stamp_ns = exposure_stamp_ns(picture)
    except ValueError:
        return []  # decoding the view says what is wrong with its picture
    known = [t for one in own if one.topic == options.transforms for t in stamped_transforms(one)]
    lacking = [one for one in recording.transforms.around(stamp_ns) if one not in known]
    if not lacking:
        return []
    data = encode_transforms(lacking)
    return [Message(topic=TRANSFORMS.name, stamp_ns=stamp_ns, sequence=index, data=data)]


def _belongs_to_views(topic: str | None, options: TopicOptions) -> bool:
    return topic in TOPICS and options.role_of(str(topic)) is not None
