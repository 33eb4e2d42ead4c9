"""A picture to the maps of a network that sees it enlarged, and tile by tile where it is large."""

from collections.abc import Callable, Iterator
from math import ceil

import cv2
import numpy as np

from canopy_skel.frame import Float32Array, UInt8Array
from canopy_skel.segmenters.unet.targets import STRIDE

MULTIPLE_PX = 32
"""The network wants pictures that are a multiple of this in height and width."""
TILE_PX = 2048
"""A picture larger than this is seen in parts."""
_OVERLAP_PX = 192


def enlarged(color_rgb: UInt8Array, zoom: float) -> UInt8Array:
    """Return an (H, W, 3) picture `zoom` times as large, each side a multiple of the stride."""
    height, width = (STRIDE * ceil(size * zoom / STRIDE) for size in color_rgb.shape[:2])
    if (height, width) == color_rgb.shape[:2]:
        return color_rgb
    larger = cv2.resize(color_rgb, (width, height), interpolation=cv2.INTER_CUBIC)
    return np.asarray(larger, dtype=np.uint8)


def tiled(
    color_rgb: UInt8Array, infer: Callable[[UInt8Array], tuple[Float32Array, ...]], tile_px: int
) -> tuple[Float32Array, ...]:
    """Return what the network says of an (H, W, 3) picture, H and W even.

    infer: says it, in arrays (K, h / 2, w / 2), of a part (h, w, 3) of the picture.
    """
    height, width = color_rgb.shape[:2]
    if max(height, width) <= tile_px:
        return infer(color_rgb)
    out: list[Float32Array] = []
    for rows, own_rows in _spans(height, tile_px):
        for columns, own_columns in _spans(width, tile_px):
            parts = infer(color_rgb[rows, columns])
            if not out:
                out = [_as_laid_out(part, height // STRIDE, width // STRIDE) for part in parts]
            top, left = rows.start // STRIDE, columns.start // STRIDE
            i, j = own_rows.start - top, own_columns.start - left
            for whole, part in zip(out, parts, strict=True):
                target = whole[:, own_rows, own_columns]
                target[:] = part[:, i : i + target.shape[1], j : j + target.shape[2]]
    return tuple(out)


def _as_laid_out(part: Float32Array, height: int, width: int) -> Float32Array:
    return np.empty_like(part, order="K", shape=(len(part), height, width))


def padded(color_rgb: UInt8Array) -> UInt8Array:
    """Return an (H, W, 3) picture whose edge is continued up to `MULTIPLE_PX`."""
    bottom, right = (-size % MULTIPLE_PX for size in color_rgb.shape[:2])
    return np.pad(color_rgb, ((0, bottom), (0, right), (0, 0)), mode="edge")


def _spans(size: int, tile_px: int) -> Iterator[tuple[slice, slice]]:
    """Yield the pixels each tile sees, and the cells of the output that are its own."""
    step = tile_px - _OVERLAP_PX
    count = max(-(-(size - _OVERLAP_PX) // step), 1)
    for k in range(count):
        start, end = k * step, min(k * step + tile_px, size)
        first = start + (_OVERLAP_PX // 2 if k else 0)
        last = end - _OVERLAP_PX // 2 if k + 1 < count else size
        yield slice(start, end), slice(first // STRIDE, -(-last // STRIDE))
