"""Recordings as they are made: after every view the file on disk is complete up to that view."""

import os
from collections.abc import Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path
from types import TracebackType
from typing import BinaryIO, Literal, Self

import numpy as np
from mcap.writer import CompressionType, Writer

from canopy_skel.errors import RecordingError, UsageError
from canopy_skel.frame import View
from canopy_skel.geometry import FloatArray
from canopy_skel.messages import EVENT, TOPICS, Message, encode_json
from canopy_skel.recording.encode import EncodedPicture, encode_view
from canopy_skel.recording.reader import METADATA_RECORD

_LIBRARY = "canopy-skel"
# Never reached: a chunk ends where a view ends, so that a cut file loses whole views.
_CHUNK_SIZE = 1 << 40
_COMPRESSION = {"zstd": CompressionType.ZSTD, "lz4": CompressionType.LZ4}


class RecordingWriter:
    """Writes one scan to `<path>.part`, and gives it its name when it is finished.

    After each view the file is flushed and synced. If the block raises, the `.part` file stays: it
    can be read and recovered. Each entry of the journal says again what the channels are, which
    before the end of the file only their first chunk would know. Not thread-safe. An existing file
    is never overwritten.

    Args:
        path: the recording to make.
        metadata: of the scan: scan_id, tree_id, rig, config, software version.
        tool_from_camera: (4, 4), the hand-eye calibration.
        compression: of the chunks.

    Raises:
        RecordingError: the file cannot be written, or is there already.
    """

    def __init__(
        self,
        path: str | Path,
        metadata: Mapping[str, str],
        *,
        tool_from_camera: FloatArray | None = None,
        compression: Literal["zstd", "lz4"] = "zstd",
    ) -> None:
        self._path = Path(path)
        self._part = self._path.with_name(self._path.name + ".part")
        self._metadata = dict(metadata)
        self._tool_from_camera = np.eye(4) if tool_from_camera is None else tool_from_camera
        self._compression = compression
        self._channels: dict[str, int] = {}
        self._indices: set[int] = set()

    def __enter__(self) -> Self:
        """Open the file and write the metadata."""
        with disk_errors(self._path), ExitStack() as opened:
            self._stream = opened.enter_context(open_new(self._path, self._part))
            self._writer = start_writer(self._stream, compression=self._compression)
            self._writer.add_metadata(METADATA_RECORD, self._metadata)
            self._sync()
            sync_folder(self._part.parent)
            opened.pop_all()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Finish and rename; after an error only close what is there."""
        with disk_errors(self._path), self._stream:
            if kind is None:
                self._writer.finish()
            else:
                self._writer.flush()
            self._stream.flush()
            os.fsync(self._stream.fileno())
        if kind is None:
            publish(self._part, self._path)

    def write_view(self, view: View, color: EncodedPicture | None = None) -> tuple[Message, ...]:
        """Write a view and return its messages, as they were written.

        Args:
            view: what was seen.
            color: the colour picture already encoded, kept unchanged; jpeg by default.
        """
        messages = encode_view(view, self._tool_from_camera, color)
        self.write_messages(messages)
        return messages

    def write_messages(self, messages: Iterable[Message]) -> None:
        """Write the messages of one view, bytes unchanged.

        Raises:
            UsageError: a view with this index was written before, or a topic is unknown.
        """
        messages = tuple(messages)
        indices = {message.sequence for message in messages}
        if self._indices & indices:
            raise UsageError(
                f"{self._path}: view {min(self._indices & indices)} is written already"
            )
        unknown = {message.topic for message in messages} - set(TOPICS)
        if unknown:
            raise UsageError(f"{min(unknown)} is not one of {', '.join(TOPICS)}")
        self._indices |= indices
        with disk_errors(self._path):
            for message in messages:
                self._add(message)
            self._writer.flush()
            self._sync()

    def write_event(self, stamp_ns: int, event: Mapping[str, object]) -> None:
        """Write an entry of the journal; it is on disk when this returns."""
        self.write_journal(
            Message(topic=EVENT.name, stamp_ns=stamp_ns, sequence=0, data=encode_json(event))
        )

    def write_journal(self, message: Message) -> None:
        """Write an entry of the journal that is encoded already."""
        with disk_errors(self._path):
            say_channels_again(self._writer)
            self._add(message)
            self._writer.flush()
            self._sync()

    def attach(self, name: str, media_type: str, data: bytes) -> None:
        """Attach a file."""
        with disk_errors(self._path):
            self._writer.flush()
            self._writer.add_attachment(0, 0, name, media_type, data)
            self._sync()

    def _add(self, message: Message) -> None:
        if message.topic not in self._channels:
            self._channels[message.topic] = register(self._writer, message.topic)
        add_message(self._writer, self._channels[message.topic], message)

    def _sync(self) -> None:
        self._stream.flush()
        os.fsync(self._stream.fileno())


def start_writer(
    stream: BinaryIO, *, profile: str = "", compression: Literal["zstd", "lz4"] = "zstd"
) -> Writer:
    """Return a started MCAP writer with all checksums, whose chunks end where it is flushed."""
    writer = Writer(
        stream,
        chunk_size=_CHUNK_SIZE,
        compression=_COMPRESSION[compression],
        enable_data_crcs=True,
    )
    writer.start(profile=profile, library=_LIBRARY)
    return writer


def register(writer: Writer, name: str) -> int:
    """Register one of canopy's topics; return the id of its channel."""
    topic = TOPICS[name]
    schema_id = writer.register_schema(topic.schema, topic.schema_encoding, topic.schema_data())
    return writer.register_channel(topic.name, topic.message_encoding, schema_id)


def say_channels_again(writer: Writer) -> None:
    """Put every schema and channel so far into the chunk in progress, as MCAP allows.

    The package keeps them, and the chunk, to itself; beside it the checksum would miss them.
    """
    own = vars(writer)
    chunk = own["_Writer__chunk_builder"]
    for schema in own["_Writer__schemas"].values():
        chunk.add_schema(schema)
    for channel in own["_Writer__channels"].values():
        chunk.add_channel(channel)


def add_message(writer: Writer, channel_id: int, message: Message) -> None:
    """Write a message to a registered channel."""
    writer.add_message(
        channel_id=channel_id,
        log_time=message.stamp_ns,
        publish_time=message.stamp_ns,
        sequence=message.sequence,
        data=message.data,
    )


def open_new(path: Path, part: Path, *, over_leftover: bool = False) -> BinaryIO:
    """Open the file `part` that will become the recording `path`, which must not be there yet.

    Raises:
        RecordingError: the recording is there; `part` is there and `over_leftover` does not allow
            to replace it; or the folder cannot be written.
    """
    if path.exists():
        raise RecordingError(f"{path}: is there already; choose another name or move it away")
    try:
        return part.open("wb" if over_leftover else "xb")
    except FileExistsError as error:
        raise RecordingError(
            f"{part}: is there already, from a scan that did not finish; `canopy recover` it, then"
            " move it away"
        ) from error
    except OSError as error:
        raise RecordingError(
            f"{path}: cannot be written ({error.strerror}); choose a folder that is there and"
            " writable"
        ) from error


def publish(part: Path, path: Path) -> None:
    """Give a finished file its name, durably."""
    with disk_errors(path):
        part.rename(path)
        sync_folder(path.parent)


def sync_folder(folder: Path) -> None:
    """Have the names in a folder, given, changed or taken, outlive a power cut."""
    if hasattr(os, "O_DIRECTORY"):
        descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


@contextmanager
def disk_errors(path: Path) -> Iterator[None]:
    """Make a RecordingError, which names the file and the mend, of what a disk refuses."""
    try:
        yield
    except OSError as error:
        raise RecordingError(f"{path}: cannot be written ({error.strerror}); check the disk") from (
            error
        )
