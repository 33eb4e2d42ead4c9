"""Rewriting recordings: a cut one into a whole one, a long one into a few views."""

from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

from mcap.writer import Writer

from canopy_skel.errors import RecordingError, UsageError
from canopy_skel.messages import Message
from canopy_skel.recording.mcap_file import McapFile, MessageReader, MessageRef, scan_mcap
from canopy_skel.recording.options import EXPOSURE_ROLES, TopicOptions
from canopy_skel.recording.reader import RECOVERY_RECORD, read_recording
from canopy_skel.recording.writer import add_message, open_new, publish, register, start_writer

_LARGE_CHUNK = 8 << 20


@dataclass(frozen=True, kw_only=True, slots=True)
class RecoverReport:
    """What was saved of a recording.

    views_saved: whole views. views_incomplete: indices of views of which only a part is there; that
    part is kept too, and readers are told. bytes_lost: after the last whole record.
    damage: one line for every damaged record that was left out.
    """

    source: Path
    target: Path
    views_saved: int
    views_incomplete: tuple[int, ...]
    messages: int
    bytes_lost: int
    damage: tuple[str, ...]

    @property
    def complete(self) -> bool:
        """Whether the target holds all that was in the source."""
        return not (self.views_incomplete or self.bytes_lost or self.damage)


def recover(
    source: str | Path, target: str | Path, topics: TopicOptions | None = None
) -> RecoverReport:
    """Rewrite a truncated or damaged recording: everything readable, bytes unchanged, indexed.

    Args:
        source: the recording (or `.part` file) to save; it is not changed.
        target: the recording to make; it must not be there yet.
        topics: names of topics, to count views.

    Raises:
        RecordingError: the source holds no message, or a file cannot be read or written.
    """
    file = scan_mcap(Path(source))
    if not file.messages:
        raise RecordingError(f"{source}: not one whole message is left in it; nothing to recover")
    views_saved, incomplete = _count_views(file.path, topics)
    marks = {}
    if incomplete:
        marks[RECOVERY_RECORD] = {"incomplete_views": ",".join(map(str, incomplete))}
    messages = rewrite(file, Path(target), lambda ref: True, marks)
    return RecoverReport(
        source=file.path,
        target=Path(target),
        views_saved=views_saved,
        views_incomplete=incomplete,
        messages=messages,
        bytes_lost=0 if file.cut_at is None else file.size - file.cut_at,
        damage=tuple(file.damage),
    )


def cut_recording(
    source: str | Path,
    target: str | Path,
    indices: Collection[int],
    topics: TopicOptions | None = None,
) -> None:
    """Copy a recording without the pictures and scores of all views but some, bytes unchanged.

    Transforms, calibrations, events, metadata and attachments stay.

    Args:
        source: the recording to copy from.
        target: the recording to make; it must not be there yet.
        indices: the views to keep.
        topics: names of topics, as for read_recording.

    Raises:
        UsageError: the recording has no such view.
        RecordingError: a file cannot be read or written.
    """
    recording = read_recording(source, topics)
    kept = [group for group in recording.groups if group.index in set(indices)]
    missing = set(indices) - {group.index for group in kept}
    if missing or not kept:
        has = ", ".join(str(group.index) for group in recording.groups)
        raise UsageError(f"{source}: no view {sorted(missing)}; it has {has}")
    keep = {ref for group in kept for ref in group.refs.values()}
    pictures = {getattr(recording.options, role) for role in EXPOSURE_ROLES}
    channels = recording.file.channels

    def wanted(ref: MessageRef) -> bool:
        return ref in keep or channels[ref.channel_id].topic not in pictures

    rewrite(recording.file, Path(target), wanted, {})


def _count_views(path: Path, topics: TopicOptions | None) -> tuple[int, tuple[int, ...]]:
    """Return how many views are whole, and which are not; (0, ()) where no camera is known."""
    try:
        recording = read_recording(path, topics)
    except RecordingError:
        return 0, ()
    whole = sum(group.flaw is None for group in recording.groups)
    return whole, recording.incomplete_views


def rewrite(
    file: McapFile,
    target: Path,
    wanted: Callable[[MessageRef], bool],
    marks: Mapping[str, dict[str, str]],
    following: Callable[[MessageRef], Iterable[Message]] = lambda ref: (),
) -> int:
    """Write the wanted messages and all the rest to a new file; return how many were copied.

    marks: metadata to add. following: messages to add after a copied one.

    Raises:
        RecordingError: the target is there already, or a file cannot be read or written.
    """
    refs = [ref for ref in file.messages if ref.channel_id in file.channels and wanted(ref)]
    part = target.with_name(target.name + ".copy.part")
    stream = open_new(target, part, over_leftover=True)
    try:
        with stream:
            writer = start_writer(stream, profile=file.profile)
            for record in file.metadata:
                writer.add_metadata(record.name, record.metadata)
            for name, content in marks.items():
                writer.add_metadata(name, content)
            _copy_messages(file, writer, refs, following)
            for attachment in file.attachments:
                writer.add_attachment(
                    attachment.create_time_ns,
                    attachment.log_time_ns,
                    attachment.name,
                    attachment.media_type,
                    file.attachment(attachment),
                )
            writer.finish()
    except BaseException:
        part.unlink(missing_ok=True)
        raise
    publish(part, target)
    return len(refs)


def _copy_messages(
    file: McapFile,
    writer: Writer,
    refs: list[MessageRef],
    following: Callable[[MessageRef], Iterable[Message]],
) -> None:
    """Copy messages; a chunk ends where it ends in the source, or when it is large."""
    reader = MessageReader(file)
    schemas = {0: 0}
    channels: dict[int, int] = {}
    added: dict[str, int] = {}
    chunk_offset, chunk_size = refs[0].chunk_offset if refs else None, 0
    for ref in refs:
        if ref.chunk_offset != chunk_offset or chunk_size > _LARGE_CHUNK:
            writer.flush()
            chunk_offset, chunk_size = ref.chunk_offset, 0
        chunk_size += ref.size
        if ref.channel_id not in channels:
            channel, schema = file.channels[ref.channel_id], file.schema_of(ref.channel_id)
            if schema.id not in schemas:
                schemas[schema.id] = writer.register_schema(
                    schema.name, schema.encoding, schema.data
                )
            channels[ref.channel_id] = writer.register_channel(
                channel.topic, channel.message_encoding, schemas[schema.id], channel.metadata
            )
        writer.add_message(
            channel_id=channels[ref.channel_id],
            log_time=ref.log_time_ns,
            data=reader.read(ref),
            publish_time=ref.publish_time_ns,
            sequence=ref.sequence,
        )
        for message in following(ref):
            if message.topic not in added:
                added[message.topic] = register(writer, message.topic)
            add_message(writer, added[message.topic], message)
    writer.flush()
