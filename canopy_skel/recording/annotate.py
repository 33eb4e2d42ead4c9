"""Branch instances into a copy of a recording; all that others wrote keeps its bytes."""

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from canopy_skel.document import RejectedView
from canopy_skel.errors import RecordingError, ViewError
from canopy_skel.frame import View
from canopy_skel.messages import (
    CAMERA_FRAME,
    INSTANCES,
    SCORES,
    Message,
    encode_raw_image,
    encode_scores,
)
from canopy_skel.recording.grouping import Group
from canopy_skel.recording.mcap_file import MessageReader, MessageRef
from canopy_skel.recording.options import TopicOptions
from canopy_skel.recording.reader import Recording, decoders_of
from canopy_skel.recording.recover import rewrite
from canopy_skel.recording.rectify import rectification
from canopy_skel.segment import BranchMask, painted


def annotate(
    recording: Recording,
    target: Path,
    segment: Callable[[View], Sequence[BranchMask]],
    progress: Callable[[int, int], None],
) -> list[RejectedView]:
    """Copy a recording with the instances of every view in place of those it may hold.

    Messages of all other topics, metadata and attachments are unchanged; the new messages follow
    the last one of their view. A view that cannot be used, or that `segment` raises ViewError for,
    is copied without instances.

    Args:
        recording: in the default topics.
        target: the recording to make; it must not be there yet.
        segment: finds the branches in a view.
        progress: called with views done and views in all.

    Returns:
        the views without instances.

    Raises:
        RecordingError: the pictures are distorted or of ROS 2, so that instances would not fit
            them, or a file cannot be read or written.
    """
    _require_own_pictures(recording)
    channels = recording.file.channels
    replaced = {INSTANCES.name, SCORES.name}
    without: list[RejectedView] = []
    done = 0

    def wanted(ref: MessageRef) -> bool:
        return channels[ref.channel_id].topic not in replaced

    kept = [(list(filter(wanted, group.refs.values())), group) for group in recording.groups]
    last = {max(refs, key=_place): group for refs, group in kept if refs}

    def following(ref: MessageRef) -> Iterator[Message]:
        nonlocal done
        if ref in last:
            yield from _found(recording, last[ref], segment, without)
            done += 1
            progress(done, len(last))

    rewrite(recording.file, target, wanted, {}, following)
    return sorted(without, key=lambda view: view.index)


def _place(ref: MessageRef) -> tuple[int, int]:
    return ref.chunk_offset or 0, ref.offset


def _found(
    recording: Recording,
    group: Group,
    segment: Callable[[View], Sequence[BranchMask]],
    without: list[RejectedView],
) -> Iterator[Message]:
    view = recording.view(group.index) if group.flaw is None else None
    if not isinstance(view, View):
        reason = group.flaw if view is None else view.reason
        without.append(RejectedView(index=group.index, reason=reason or ""))
        return
    try:
        masks = segment(view)
    except ViewError as error:
        without.append(RejectedView(index=view.index, reason=str(error)))
        return
    instances, scores = painted(masks, (view.intrinsics.height_px, view.intrinsics.width_px))
    for topic, data in (
        (INSTANCES, encode_raw_image(instances, "16UC1", view.stamp_ns, CAMERA_FRAME)),
        (SCORES, encode_scores(scores)),
    ):
        yield Message(topic=topic.name, stamp_ns=view.stamp_ns, sequence=view.index, data=data)


def _require_own_pictures(recording: Recording) -> None:
    """Refuse recordings whose views are not the very pictures of the file.

    Raises:
        RecordingError: of ROS 2, of other topics than ours, or distorted.
    """
    mend = "replay it with `--segmenter` instead, which writes nothing into the recording"
    if recording.file.profile == "ros2" or recording.options != TopicOptions():
        raise RecordingError(
            f"{recording.path}: instances can be written only beside canopy's own topics; {mend}"
        )
    reader, decoders = MessageReader(recording.file), decoders_of(recording.file)
    calibrations = {
        ref
        for group in recording.groups
        for role, ref in group.refs.items()
        if role in ("color_calibration", "left_calibration")
    }
    for ref in sorted(calibrations, key=_place):
        channel = recording.file.channels[ref.channel_id]
        schema = recording.file.schema_of(ref.channel_id).name
        try:
            lens = decoders[channel.message_encoding].calibration(schema, reader.read(ref))
            distorted = rectification(lens, rectified=False).map_u is not None
        except ValueError:
            continue  # the view says so itself
        if distorted:
            raise RecordingError(
                f"{recording.path}: its pictures are distorted, and the instances are found in"
                f" undistorted ones; {mend}"
            )
