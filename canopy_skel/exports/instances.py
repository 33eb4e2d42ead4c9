"""Branch instances over a picture."""

import colorsys
from collections.abc import Sequence

import cv2
import numpy as np

from canopy_skel.frame import UInt8Array
from canopy_skel.segment import BranchMask

_GOLDEN = 0.6180339887
_OPACITY = 0.45
_DARK = (12, 12, 12)
_PLATE_PX = 3


def draw_instances(color_rgb: UInt8Array, masks: Sequence[BranchMask]) -> UInt8Array:
    """Return an (H, W, 3) copy with every instance tinted, outlined, and its confidence written."""
    image = np.ascontiguousarray(color_rgb).copy()
    for number, mask in enumerate(masks):
        tint = np.array(colorsys.hsv_to_rgb(number * _GOLDEN % 1.0, 0.85, 1.0)) * 255
        height, width = mask.mask.shape
        part = image[mask.top_px : mask.top_px + height, mask.left_px : mask.left_px + width]
        mixed = (1 - _OPACITY) * part[mask.mask] + _OPACITY * tint
        part[mask.mask] = mixed.astype(np.uint8)
        outlines, _ = cv2.findContours(
            mask.mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE
        )
        for outline in outlines:
            part[outline[:, 0, 1], outline[:, 0, 0]] = tint.astype(np.uint8)
    for mask in masks:
        _write(image, mask)
    return image


def _write(image: UInt8Array, mask: BranchMask) -> None:
    """Write the confidence in the middle of an instance, on a dark plate."""
    scale = max(0.35, image.shape[0] / 2400)
    rows, columns = np.nonzero(mask.mask)
    middle = len(rows) // 2
    text = f"{mask.confidence:.2f}"
    font = cv2.FONT_HERSHEY_SIMPLEX
    (width, height), _ = cv2.getTextSize(text, font, scale, 1)
    u = int(np.clip(mask.left_px + columns[middle], 0, max(image.shape[1] - width, 0)))
    v = int(np.clip(mask.top_px + rows[middle], height, max(image.shape[0] - 1, height)))
    corners = (u - _PLATE_PX, v + _PLATE_PX), (u + width + _PLATE_PX, v - height - _PLATE_PX)
    cv2.rectangle(image, *corners, _DARK, -1)
    cv2.putText(image, text, (u, v), font, scale, (255, 255, 255), 1, cv2.LINE_AA)
