"""Go on with a recording that was cut short: its whole views and its journal, bytes unchanged."""

from collections.abc import Iterator
from pathlib import Path

from canopy_skel.errors import RecordingError
from canopy_skel.messages import COLOR_IMAGE, EVENT, LEFT_IMAGE, TRANSFORMS, Message
from canopy_skel.recording.mcap_file import McapFile, MessageReader, MessageRef, scan_mcap
from canopy_skel.recording.reader import read_recording
from canopy_skel.recording.writer import RecordingWriter


def carry_over(source: Path, writer: RecordingWriter) -> tuple[int, ...]:
    """Copy the whole views and the journal of an unfinished recording; return the views' indices.

    Raises:
        RecordingError: the source cannot be read, or the target not be written.
    """
    file = scan_mcap(source)
    unknown = sum(ref.channel_id not in file.channels for ref in file.messages)
    if unknown:  # to go on without them would be to lose them
        raise RecordingError(
            f"{source}: is damaged where it says what {unknown} of its messages are; copy it if it"
            " is worth a try to save them, cancel the scan, and scan the tree anew"
        )
    for message in _journal(file):
        writer.write_journal(message)
    if not _has_pictures(file):
        return ()
    recording = read_recording(source)
    reader = MessageReader(file)
    whole = [group for group in recording.groups if group.flaw is None]
    for group in whole:
        poses = [ref for ref in _on_topics(file, TRANSFORMS.name) if ref.sequence == group.index]
        own = sorted({*poses, *group.refs.values()}, key=_place)
        writer.write_messages(_message(file, ref, reader) for ref in own)
    return tuple(group.index for group in whole)


def _journal(file: McapFile) -> Iterator[Message]:
    reader = MessageReader(file)
    for ref in _on_topics(file, EVENT.name):
        yield _message(file, ref, reader)


def _place(ref: MessageRef) -> tuple[int, int]:
    return ref.chunk_offset or 0, ref.offset


def _has_pictures(file: McapFile) -> bool:
    return bool(_on_topics(file, COLOR_IMAGE.name) or _on_topics(file, LEFT_IMAGE.name))


def _on_topics(file: McapFile, topic: str) -> list[MessageRef]:
    return [ref for ref in file.messages if file.channels[ref.channel_id].topic == topic]


def _message(file: McapFile, ref: MessageRef, reader: MessageReader) -> Message:
    return Message(
        topic=file.channels[ref.channel_id].topic,
        stamp_ns=ref.log_time_ns,
        sequence=ref.sequence,
        data=reader.read(ref),
    )
