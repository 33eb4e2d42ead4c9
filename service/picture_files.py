"""Pictures that users hand in, as 8-bit RGB."""

from pathlib import Path

import cv2
import numpy as np

from canopy_skel.errors import UsageError
from canopy_skel.frame import UInt8Array

SUFFIXES = frozenset({".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp", ".webp"})


def read_picture(path: Path) -> UInt8Array:
    """Return the (H, W, 3) RGB picture in a file.

    Grey ones get three equal channels. Of 16-bit ones the highest eight bits in use are kept
    (cameras put 10 or 12 bits into 16). Transparency is dropped. The orientation that a camera
    noted (EXIF) is applied, as annotation tools do.

    Raises:
        UsageError: the file cannot be read, or is no picture.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise UsageError(f"{path}: cannot be read ({error.strerror}); check the path") from error
    return decode_picture(data, str(path))


def decode_picture(data: bytes, source: str) -> UInt8Array:
    """Return the (H, W, 3) RGB picture in encoded bytes; see `read_picture`."""
    try:
        flags = cv2.IMREAD_ANYDEPTH | cv2.IMREAD_COLOR
        found = cv2.imdecode(np.frombuffer(data, dtype=np.uint8), flags) if data else None
    except cv2.error as error:
        raise UsageError(f"{source}: {_too_large(str(error))}") from error
    if found is None:
        raise UsageError(
            f"{source}: is no picture that can be read ({len(data)} bytes); give a whole jpeg, png"
            " or tiff file"
        )
    rgb: UInt8Array = np.ascontiguousarray(_eight_bit(np.asarray(found), source)[..., ::-1])
    return rgb


def _eight_bit(picture: np.ndarray, source: str) -> np.ndarray:
    if picture.dtype == np.uint8:
        return picture
    if picture.dtype != np.uint16:
        raise UsageError(f"{source}: has pixels of type {picture.dtype}; save it with 8 or 16 bits")
    spare_bits = max(int(picture.max()).bit_length() - 8, 0)
    return (picture >> spare_bits).astype(np.uint8)


def _too_large(message: str) -> str:
    if "CV_IO_MAX_IMAGE_PIXELS" in message or "memory" in message.lower():
        return "is too large to be decoded; scale it down (branches need about 6 pixels of width)"
    return "cannot be decoded; give a whole jpeg, png or tiff file"
