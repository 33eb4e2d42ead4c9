"""What an MCAP file holds, found by one pass that survives truncation and damage.

The stock readers trust the index at the end of the file, or stop at the first bad byte. This pass
frames every record by its length, checks every checksum the file carries, and remembers where each
message is; the messages themselves are read when they are asked for.
"""

import os
import struct
import zlib
from collections import OrderedDict
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from io import BytesIO
from pathlib import Path
from typing import BinaryIO, NamedTuple

import zstandard
from lz4.frame import LZ4FrameDecompressor
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Chunk, DataEnd, Header, Metadata, Schema
from mcap.stream_reader import CRCValidationError, get_chunk_data_stream
from mcap.writer import MCAP0_MAGIC

from canopy_skel.errors import RecordingError

_RECORD_HEAD = struct.Struct("<BQ")
_MESSAGE_HEAD = struct.Struct("<HIQQ")
_CHUNKS_IN_MEMORY = 4
MOST_CHUNK_BYTES = 1 << 28
"""Of a chunk that is read, packed or not, and of any other record that is read as one; recorders
make chunks of a few MiB, or of one large picture."""
_PIECE_BYTES = 1 << 20
# The other kinds are indices, which a pass does without, and what is yet to be invented.
_READ = frozenset(
    {
        Opcode.HEADER,
        Opcode.SCHEMA,
        Opcode.CHANNEL,
        Opcode.MESSAGE,
        Opcode.CHUNK,
        Opcode.METADATA,
        Opcode.DATA_END,
    }
)
# What the parsers of the mcap package and the decompressors (lz4: RuntimeError) raise on damage.
_DAMAGE = (
    McapError,
    CRCValidationError,
    struct.error,
    ValueError,
    OverflowError,
    MemoryError,
    RuntimeError,
    zstandard.ZstdError,
)


class MessageRef(NamedTuple):
    """Where a message is: at `offset` of its chunk, or of the file where there is no chunk."""

    channel_id: int
    sequence: int
    log_time_ns: int
    publish_time_ns: int
    chunk_offset: int | None
    offset: int
    size: int


@dataclass(frozen=True, kw_only=True, slots=True)
class AttachmentRef:
    """An attached file: its name, media type, size in bytes, and where its record starts."""

    name: str
    media_type: str
    size: int
    create_time_ns: int
    log_time_ns: int
    record_offset: int


@dataclass(kw_only=True, slots=True)
class McapFile:
    """The content of an MCAP file.

    cut_at: offset of the first byte that belongs to no whole record, None where the file is whole.
    damage: one line for every record that failed its checksum or its parser.
    """

    path: Path
    size: int
    profile: str = ""
    library: str = ""
    cut_at: int | None = None
    damage: list[str] = field(default_factory=list)
    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    messages: list[MessageRef] = field(default_factory=list)
    metadata: list[Metadata] = field(default_factory=list)
    attachments: list[AttachmentRef] = field(default_factory=list)

    def schema_of(self, channel_id: int) -> Schema:
        """Return the schema of a channel; an empty one where the channel has none."""
        schema_id = self.channels[channel_id].schema_id
        return self.schemas.get(schema_id) or Schema(id=0, data=b"", encoding="", name="")

    def attachment(self, ref: AttachmentRef) -> bytes:
        """Read the data of an attachment."""
        with _disk_errors(self.path), open_recording(self.path) as stream:
            return bytes(Attachment.read(_fields(_record_at(stream, ref.record_offset))).data)


def scan_mcap(path: Path) -> McapFile:
    """Walk the whole file once.

    Raises:
        RecordingError: no such file, not readable, or not MCAP.
    """
    with _disk_errors(path), open_recording(path) as stream:
        size = os.fstat(stream.fileno()).st_size
        magic = stream.read(len(MCAP0_MAGIC))
        if not magic or not MCAP0_MAGIC.startswith(magic):
            raise RecordingError(
                f"{path}: {'is empty' if not magic else 'is not an MCAP file'};"
                " give an MCAP recording (ROS 1 bags and .db3 files: convert with `mcap convert`)"
            )
        file = McapFile(path=path, size=size)
        _Walk(file).run(stream)
    return file


def open_recording(path: Path) -> BinaryIO:
    """Open for reading, or raise RecordingError with one line that says why not."""
    try:
        return path.open("rb")
    except FileNotFoundError as error:
        raise RecordingError(f"{path}: no such file; check the path") from error
    except IsADirectoryError as error:
        raise RecordingError(f"{path}: is a folder; name the MCAP file in it") from error
    except OSError as error:
        raise _unreadable(path, error) from error


@contextmanager
def _disk_errors(path: Path) -> Iterator[None]:
    """A file on a bad disk opens well, and fails where it is read."""
    try:
        yield
    except OSError as error:
        raise _unreadable(path, error) from error


def _unreadable(path: Path, error: OSError) -> RecordingError:
    return RecordingError(
        f"{path}: cannot be read ({error.strerror}); check its permissions and the disk"
    )


class _Walk:
    """One pass over the records of a file; fills an McapFile."""

    def __init__(self, file: McapFile) -> None:
        self._file = file
        self._data_crc = zlib.crc32(MCAP0_MAGIC)

    def run(self, stream: BinaryIO) -> None:
        """Read records until the footer, the end of the file, or bytes that are no record."""
        offset = len(MCAP0_MAGIC)
        if self._file.size < offset:
            self._file.cut_at = 0
            return
        while True:
            head = stream.read(_RECORD_HEAD.size)
            opcode, length = _RECORD_HEAD.unpack(head) if len(head) == 9 else (0, 0)
            if opcode == 0 or length > self._file.size - offset - 9:
                self._file.cut_at = offset
                return
            if opcode == Opcode.FOOTER:
                stream.seek(length, os.SEEK_CUR)
                if stream.read(len(MCAP0_MAGIC)) != MCAP0_MAGIC:
                    self._file.cut_at = offset + 9 + length
                return
            crc_before, self._data_crc = self._data_crc, zlib.crc32(head, self._data_crc)
            pieces = self._pieces(stream, length)
            try:
                if opcode == Opcode.ATTACHMENT:
                    self._attachment(pieces, length, offset)
                elif opcode in _READ:
                    _require_readable(length)
                    self._record(opcode, b"".join(pieces), offset, crc_before)
            except _DAMAGE as error:
                kind = _name(opcode)
                self._file.damage.append(f"the {kind} at byte {offset} is damaged ({error})")
            for _ in pieces:
                pass  # what is not read counts into the checksum too
            offset += 9 + length

    def _pieces(self, stream: BinaryIO, length: int) -> Iterator[bytes]:
        """Read the body of a record, which may be larger than memory, and count it as data."""
        while length and (piece := stream.read(min(length, _PIECE_BYTES))):
            self._data_crc = zlib.crc32(piece, self._data_crc)
            length -= len(piece)
            yield piece

    def _record(self, opcode: int, body: bytes, offset: int, crc_before: int) -> None:
        file = self._file
        if opcode == Opcode.HEADER:
            header = Header.read(_fields(body))
            file.profile, file.library = header.profile, header.library
        elif opcode == Opcode.CHUNK:
            self._chunk(Chunk.read(_fields(body)), offset)
        elif opcode == Opcode.METADATA:
            file.metadata.append(Metadata.read(_fields(body)))
        elif opcode == Opcode.DATA_END:
            expected = DataEnd.read(_fields(body)).data_section_crc
            if expected not in (0, crc_before) and not file.damage:
                file.damage.append("the checksum of the file's data does not match")
        else:
            self._small_record(opcode, body, None, offset + 9)

    def _chunk(self, chunk: Chunk, chunk_offset: int) -> None:
        data = _decompress(chunk)
        for opcode, start, size in _records_in(data):
            self._small_record(opcode, data[start : start + size], chunk_offset, start)

    def _small_record(
        self, opcode: int, body: bytes | memoryview, chunk_offset: int | None, start: int
    ) -> None:
        """Note a schema, a channel or a message whose body starts at `start`."""
        if opcode == Opcode.SCHEMA:
            schema = Schema.read(_fields(bytes(body)))
            self._file.schemas.setdefault(schema.id, schema)
        elif opcode == Opcode.CHANNEL:
            channel = Channel.read(_fields(bytes(body)))
            self._file.channels.setdefault(channel.id, channel)
        elif opcode == Opcode.MESSAGE:
            head = _MESSAGE_HEAD.size
            channel_id, sequence, log_time_ns, publish_time_ns = _MESSAGE_HEAD.unpack(body[:head])
            self._file.messages.append(
                MessageRef(
                    channel_id,
                    sequence,
                    log_time_ns,
                    publish_time_ns,
                    chunk_offset,
                    start + head,
                    len(body) - head,
                )
            )

    def _attachment(self, pieces: Iterator[bytes], length: int, offset: int) -> None:
        """Note an attachment whose data stays where it is; its name and type are in one piece."""
        head = next(pieces, b"")
        actual, last = 0, head
        for piece in pieces:
            actual, last = zlib.crc32(last[:-4], actual), last[-4:] + piece
        actual = zlib.crc32(last[:-4], actual)
        (expected,) = struct.unpack("<I", last[-4:])
        fields = _fields(head)
        ref = AttachmentRef(
            log_time_ns=fields.read8(),
            create_time_ns=fields.read8(),
            name=fields.read_prefixed_string(),
            media_type=fields.read_prefixed_string(),
            size=fields.read8(),
            record_offset=offset,
        )
        if fields.count + ref.size + 4 > length:
            raise ValueError(f"{ref.name!r} is cut off")
        if expected not in (0, actual):
            raise ValueError(f"checksum of {ref.name!r} does not match")
        self._file.attachments.append(ref)


def _require_readable(length: int) -> None:
    if length > MOST_CHUNK_BYTES:
        raise ValueError(f"it has {length} bytes, more than {MOST_CHUNK_BYTES}")


class MessageReader:
    """Reads messages of one file by reference, keeping the last few chunks in memory."""

    def __init__(self, file: McapFile) -> None:
        self._path = file.path
        self._chunks: OrderedDict[int, bytes] = OrderedDict()

    def read(self, ref: MessageRef) -> bytes:
        """Return the data of a message.

        Raises:
            RecordingError: the file has changed or vanished since it was scanned, or the disk
                does not give it.
        """
        try:
            with _disk_errors(self._path):
                return self._read(ref)
        except _DAMAGE as error:
            raise RecordingError(f"{self._path}: changed while it was read ({error})") from error

    def _read(self, ref: MessageRef) -> bytes:
        head_offset = ref.offset - _MESSAGE_HEAD.size
        if ref.chunk_offset is None:
            with open_recording(self._path) as stream:
                stream.seek(head_offset)
                head, data = stream.read(_MESSAGE_HEAD.size), stream.read(ref.size)
        else:
            chunk = self._chunk(ref.chunk_offset)
            head, data = chunk[head_offset : ref.offset], chunk[ref.offset : ref.offset + ref.size]
        if len(data) != ref.size or _MESSAGE_HEAD.unpack(head) != ref[:4]:
            raise ValueError(f"another message is at byte {ref.offset}")
        return data

    def _chunk(self, offset: int) -> bytes:
        if offset not in self._chunks:
            with open_recording(self._path) as stream:
                chunk = Chunk.read(_fields(_record_at(stream, offset)))
            self._chunks[offset] = bytes(_decompress(chunk))
            if len(self._chunks) > _CHUNKS_IN_MEMORY:
                self._chunks.popitem(last=False)
        self._chunks.move_to_end(offset)
        return self._chunks[offset]


def _record_at(stream: BinaryIO, offset: int) -> bytes:
    stream.seek(offset)
    _, length = _RECORD_HEAD.unpack(stream.read(_RECORD_HEAD.size))
    body = stream.read(length)
    if len(body) != length:
        raise ValueError(f"the record at byte {offset} is cut off")
    return body


def _records_in(data: memoryview) -> Iterator[tuple[int, int, int]]:
    """Yield opcode, start and size of the body of every record of a chunk."""
    offset = 0
    while offset < len(data):
        opcode, size = _RECORD_HEAD.unpack(data[offset : offset + 9])
        if size > len(data) - offset - 9:
            raise ValueError("a record reaches past the end of its chunk")
        yield opcode, offset + 9, size
        offset += 9 + size


def _decompress(chunk: Chunk) -> memoryview:
    """Return what a chunk holds, never more than it says and MOST_CHUNK_BYTES: it may be a bomb."""
    size = chunk.uncompressed_size
    if size > MOST_CHUNK_BYTES:
        raise ValueError(f"it says it holds {size} bytes, more than {MOST_CHUNK_BYTES}")
    if chunk.compression == "zstd":
        data = zstandard.ZstdDecompressor().stream_reader(chunk.data).read(size + 1)
    elif chunk.compression == "lz4":
        data = LZ4FrameDecompressor().decompress(chunk.data, max_length=size + 1)
    else:
        data = chunk.data
    if len(data) != size:
        raise ValueError(f"it does not hold the {size} bytes that it says")
    plain = replace(chunk, compression="", data=data)
    stream, size = get_chunk_data_stream(plain, validate_crc=True)
    return memoryview(stream.read(size) if size else b"")


def _fields(body: bytes) -> ReadDataStream:
    return ReadDataStream(BytesIO(body))


def _name(opcode: int) -> str:
    try:
        return Opcode(opcode).name.lower()
    except ValueError:
        return f"record of unknown kind {opcode}"
