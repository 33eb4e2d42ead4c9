"""Pixels of image messages: from bytes to arrays, and from arrays to what a view holds.

Every function raises ValueError with a text that says what is wrong with the picture.
"""

from contextlib import suppress
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from canopy_skel.frame import Float32Array, UInt8Array, UInt16Array

Pixels = NDArray[Any]

# encoding -> (dtype of a sample, samples per pixel, order of the samples as RGB or None)
_RAW_PIXELS: dict[str, tuple[str, int, tuple[int, ...] | None]] = {
    "mono8": ("u1", 1, None),
    "8UC1": ("u1", 1, None),
    "rgb8": ("u1", 3, (0, 1, 2)),
    "bgr8": ("u1", 3, (2, 1, 0)),
    "8UC3": ("u1", 3, (2, 1, 0)),
    "rgba8": ("u1", 4, (0, 1, 2)),
    "bgra8": ("u1", 4, (2, 1, 0)),
    "mono16": ("u2", 1, None),
    "16UC1": ("u2", 1, None),
    "32FC1": ("f4", 1, None),
}


def pixels_from_raw(
    data: bytes,
    *,
    width_px: int,
    height_px: int,
    step: int,
    encoding: str,
    is_bigendian: bool = False,
) -> Pixels:
    """Return the pixels of an uncompressed image, colour as RGB, in native byte order.

    Args:
        data: rows of `step` bytes, the padding at the end of the last row may be missing.
        width_px: pixels per row.
        height_px: rows.
        step: bytes from one row to the next.
        encoding: a ROS / Foxglove name such as "16UC1".
        is_bigendian: byte order of the samples.

    Raises:
        ValueError: the encoding is unknown, or the numbers do not fit the data.
    """
    if encoding not in _RAW_PIXELS:
        raise ValueError(f"encoding {encoding!r} is not one of {', '.join(sorted(_RAW_PIXELS))}")
    kind, channels, rgb = _RAW_PIXELS[encoding]
    dtype = np.dtype(kind).newbyteorder(">" if is_bigendian else "<")
    row = width_px * channels * dtype.itemsize
    if width_px < 1 or height_px < 1 or step < row or len(data) < step * (height_px - 1) + row:
        raise ValueError(
            f"{width_px}x{height_px} {encoding} with {step} bytes per row does not fit"
            f" {len(data)} bytes of data"
        )
    shape, strides = (
        (height_px, width_px, channels),
        (step, channels * dtype.itemsize, dtype.itemsize),
    )
    pixels = np.ndarray(shape, dtype, buffer=data, strides=strides)
    pixels = pixels[..., 0] if rgb is None else pixels[..., rgb]
    return np.ascontiguousarray(pixels, dtype=dtype.newbyteorder("="))


def pixels_from_compressed(data: bytes, picture_format: str) -> Pixels:
    """Return the pixels of a jpeg, png or webp: RGB uint8, or one channel of 8 or 16 bits.

    Raises:
        ValueError: the bytes are not such a picture.
    """
    flags = cv2.IMREAD_ANYDEPTH | cv2.IMREAD_ANYCOLOR | cv2.IMREAD_IGNORE_ORIENTATION
    decoded: Pixels | None = None
    if data:
        with suppress(cv2.error):
            decoded = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    if decoded is None:
        raise ValueError(
            f"the {picture_format or 'compressed'} picture ({len(data)} bytes) cannot be decoded;"
            " record it whole, as jpeg, png or webp"
        )
    return decoded if decoded.ndim == 2 else cv2.cvtColor(decoded, cv2.COLOR_BGR2RGB)


def little_endian(pixels: Pixels, encoding: str) -> Pixels:
    """Return contiguous pixels with the sample type of `encoding`, little endian."""
    dtype = np.dtype(_RAW_PIXELS[encoding][0]).newbyteorder("<")
    return np.ascontiguousarray(pixels, dtype=dtype)


def as_rgb(pixels: Pixels) -> UInt8Array:
    """Return (H, W, 3) uint8 of a colour or grey picture of 8 bits."""
    if pixels.dtype != np.uint8:
        raise ValueError(f"has samples of {pixels.dtype}; a colour picture has 8 bits")
    rgb: UInt8Array = np.stack([pixels] * 3, axis=-1) if pixels.ndim == 2 else pixels
    return rgb


def as_mono(pixels: Pixels) -> UInt8Array:
    """Return (H, W) uint8 of a colour or grey picture of 8 bits."""
    if pixels.dtype != np.uint8:
        raise ValueError(f"has samples of {pixels.dtype}; a stereo picture has 8 bits")
    mono: Pixels = pixels if pixels.ndim == 2 else cv2.cvtColor(pixels, cv2.COLOR_RGB2GRAY)
    return mono


def as_depth_m(pixels: Pixels) -> Float32Array:
    """Return (H, W) float32 metres, NaN = no return, of uint16 millimetres or float32 metres.

    Zero, negative and infinite depths are no returns.
    """
    if pixels.ndim != 2 or pixels.dtype not in (np.uint16, np.float32):
        raise ValueError(
            f"has samples of {pixels.dtype}; depth is 16UC1 (millimetres) or 32FC1 (metres)"
        )
    metres = pixels.astype(np.float32)
    if pixels.dtype == np.uint16:
        metres /= np.float32(1000)
    metres[~((metres > 0) & np.isfinite(metres))] = np.nan
    if np.isnan(metres).all():
        raise ValueError("holds no return at all (every pixel is 0); check the depth camera")
    return metres


def depth_to_millimetres(depth_m: Float32Array) -> UInt16Array:
    """Return (H, W) uint16 millimetres, 0 = no return or farther than 65.535 m."""
    millimetres = np.rint(np.nan_to_num(depth_m, nan=0.0) * np.float32(1000))
    return np.where(millimetres > np.iinfo(np.uint16).max, 0, millimetres).astype(np.uint16)


def as_instances(pixels: Pixels) -> UInt16Array:
    """Return (H, W) uint16 ids of a picture with one channel of 8 or 16 bits."""
    if pixels.ndim != 2 or pixels.dtype not in (np.uint8, np.uint16):
        raise ValueError(f"has samples of {pixels.dtype}; instance ids are 16UC1")
    return pixels.astype(np.uint16)
