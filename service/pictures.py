"""Single pictures out of recordings, also out of those that still grow."""

import os
from contextlib import suppress
from enum import StrEnum
from pathlib import Path
from threading import Lock
from typing import BinaryIO

import cv2
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage

from canopy_skel.errors import RecordingError
from canopy_skel.pixels import Pixels, as_depth_m, depth_to_millimetres
from canopy_skel.recording import Recording, read_recording
from canopy_skel.recording.mcap_file import MessageReader, MessageRef
from canopy_skel.recording.reader import decoders_of

_JPEG_QUALITY = 95


class PictureKind(StrEnum):
    """Which picture of a view; the values are media types."""

    COLOR_JPEG = "image/jpeg"
    DEPTH_PNG = "image/png"


class NoPictureError(Exception):
    """The recording does not hold this picture, or not yet."""


class Pictures:
    """Reads pictures; remembers the recording it read last, until that has grown."""

    def __init__(self) -> None:
        self._lock = Lock()
        self._size = -1
        self._recording: Recording | None = None

    def read(self, path: Path | None, index: int, kind: PictureKind) -> bytes:
        """Return an encoded picture of view `index`; depth as 16 bit millimetres.

        Raises:
            NoPictureError: it is not there.
        """
        try:
            return self._picture(path, index, kind)
        except NoPictureError:
            # A recording gets its final name when it is whole, perhaps just now.
            if path is None or not path.name.endswith(".part") or path.exists():
                raise
            return self._picture(path, index, kind)

    def _picture(self, path: Path | None, index: int, kind: PictureKind) -> bytes:
        recording = self._open(path)
        role = "depth_image" if kind is PictureKind.DEPTH_PNG else _color_role(recording, index)
        ref = next((g.refs.get(role) for g in recording.groups if g.index == index), None)
        if ref is None:
            raise NoPictureError(
                f"view {index} has no such picture; views of this recording:"
                f" {', '.join(str(group.index) for group in recording.groups) or 'none yet'}"
            )
        try:
            return _encoded(recording, ref, kind)
        except (RecordingError, OSError, ValueError) as error:
            raise NoPictureError(f"view {index}: {error}") from error

    def _open(self, path: Path | None) -> Recording:
        file = recorded_file(path)
        if file is None:
            raise NoPictureError("the scan has no recording yet")
        with self._lock:
            try:
                size = file.stat().st_size
                if self._recording is None or (self._recording.path, self._size) != (file, size):
                    self._recording, self._size = read_recording(file), size
            except (RecordingError, OSError) as error:
                raise NoPictureError(f"no view is recorded yet ({error})") from error
            return self._recording


def recorded_file(path: Path | None) -> Path | None:
    """Return where a recording lies now: under its name, or under `.part` while it grows.

    While a scan that goes on copies what was set aside (`service.scan`), the copy lacks some.
    """
    if path is None:
        return None
    whole = path.with_name(path.name.removesuffix(".part"))
    growing = (whole.with_name(f"{whole.name}.{suffix}") for suffix in ("aside", "part"))
    return next((file for file in (whole, *growing) if os.access(file, os.R_OK)), None)


def open_recorded(path: Path | None) -> BinaryIO | None:
    """Open a recording where it lies now, None if it does not; the caller closes it."""
    for _ in range(2):  # it gets its final name when it is whole, perhaps between look and open
        file = recorded_file(path)
        if file is not None:
            with suppress(FileNotFoundError):
                return file.open("rb")
    return None


def _color_role(recording: Recording, index: int) -> str:
    has_color = any("color_image" in g.refs for g in recording.groups if g.index == index)
    return "color_image" if has_color else "left_image"


def _encoded(recording: Recording, ref: MessageRef, kind: PictureKind) -> bytes:
    file = recording.file
    data = MessageReader(file).read(ref)
    schema = file.schema_of(ref.channel_id).name
    if kind is PictureKind.COLOR_JPEG and schema == CompressedImage.DESCRIPTOR.full_name:
        compressed = CompressedImage.FromString(data)
        if compressed.format in ("jpeg", "jpg"):
            return compressed.data
    decoder = decoders_of(file)[file.channels[ref.channel_id].message_encoding]
    pixels = decoder.picture(schema, data).pixels
    return _jpeg(pixels) if kind is PictureKind.COLOR_JPEG else _png(pixels)


def _jpeg(pixels: Pixels) -> bytes:
    bgr = pixels[:, :, ::-1] if pixels.ndim == 3 else pixels
    done, encoded = cv2.imencode(".jpg", bgr.copy(), [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])
    if not done:
        raise ValueError("the picture cannot be encoded as JPEG")
    return encoded.tobytes()


def _png(depth: Pixels) -> bytes:
    if depth.dtype != "uint16":
        depth = depth_to_millimetres(as_depth_m(depth))
    done, encoded = cv2.imencode(".png", depth)
    if not done:
        raise ValueError("the depth picture cannot be encoded as PNG")
    return encoded.tobytes()
