"""Crops for training: cut, turned, scaled and recoloured at random."""

from dataclasses import dataclass

import cv2
import numpy as np

from canopy_skel.frame import Float32Array, UInt8Array
from canopy_skel.segmenters.unet.targets import (
    ANGLE,
    ANGLE_STEPS,
    RADIUS,
    RADIUS_PX,
    STATE,
    Target,
    places_of,
)
from service.training.store import StoredImages

_ZOOM = (0.72, 1.4)
_ON_WOOD = 0.6


@dataclass(frozen=True, kw_only=True, eq=False, slots=True)
class Batch:
    """Crops and what they ask of the network.

    color_rgb: (N, S, S, 3) uint8. maps: (N, S / 2, S / 2, 5) uint8, see `targets_of`. places:
    (N, S / 2, S / 2, 3), see `places_of`; pieces end where the crop does.
    """

    color_rgb: UInt8Array
    maps: UInt8Array
    places: Float32Array


def draw_batch(
    images: StoredImages, rng: np.random.Generator, *, count: int, size_px: int
) -> Batch:
    """Draw `count` crops of `size_px`, from as many pictures."""
    crops = [_crop(images, int(rng.integers(len(images))), rng, size_px) for _ in range(count)]
    return Batch(
        color_rgb=np.stack([color for color, _ in crops]),
        maps=np.stack([maps for _, maps in crops]),
        places=np.stack([places_of(maps) for _, maps in crops]),
    )


def _crop(
    images: StoredImages, index: int, rng: np.random.Generator, size_px: int
) -> tuple[UInt8Array, UInt8Array]:
    color, maps = images.color(index), images.maps(index)
    zoom = float(np.exp(rng.uniform(*np.log(_ZOOM))))
    half = min(round(size_px / zoom / 2), *maps.shape[:2])
    top, left = _corner(maps, half, rng)
    part = np.ascontiguousarray(color[2 * top : 2 * (top + half), 2 * left : 2 * (left + half)])
    way = cv2.INTER_AREA if half * 2 > size_px else cv2.INTER_LINEAR
    part = np.asarray(cv2.resize(part, (size_px, size_px), interpolation=way), dtype=np.uint8)
    near = (np.arange(size_px // 2) + 0.5) * (2 * half / size_px)
    rows, columns = top + near.astype(np.int64), left + near.astype(np.int64)
    target = np.array(maps[rows[:, None], columns])
    _scale_radius(target, size_px / (2 * half))
    part, target = _turned(part, target, rng)
    return _recoloured(part, rng), target


def _corner(maps: UInt8Array, half: int, rng: np.random.Generator) -> tuple[int, int]:
    """Return where a crop starts: often around a cell of some branch, else anywhere."""
    most = np.array(maps.shape[:2]) - half
    if rng.random() < _ON_WOOD:
        step = 3
        wood = np.argwhere(maps[::step, ::step, STATE] == Target.BRANCH)
        if len(wood):
            middle = step * wood[int(rng.integers(len(wood)))]
            shift = rng.integers(-half // 3, half // 3 + 1, size=2)
            top, left = np.clip(middle + shift - half // 2, 0, most)
            return int(top), int(left)
    top, left = rng.integers(0, most + 1)
    return int(top), int(left)


def _scale_radius(maps: UInt8Array, factor: float) -> None:
    low, high = np.log(RADIUS_PX)
    shifted = maps[..., RADIUS] + 255 * np.log(factor) / (high - low)
    maps[..., RADIUS] = np.rint(np.clip(shifted, 0, 255)).astype(np.uint8)


def _turned(
    color: UInt8Array, maps: UInt8Array, rng: np.random.Generator
) -> tuple[UInt8Array, UInt8Array]:
    """Mirror and transpose; angles follow (v is down, angles modulo 180 degrees)."""
    angle = maps[..., ANGLE].astype(np.int64)
    if rng.random() < 0.5:
        color, maps, angle = color[:, ::-1], maps[:, ::-1], -angle[:, ::-1]
    if rng.random() < 0.2:
        color, maps, angle = color[::-1], maps[::-1], -angle[::-1]
    if rng.random() < 0.25:
        color, maps = color.swapaxes(0, 1), maps.swapaxes(0, 1)
        angle = ANGLE_STEPS // 2 - angle.swapaxes(0, 1)
    maps = maps.copy()
    maps[..., ANGLE] = np.mod(angle, ANGLE_STEPS)
    return np.ascontiguousarray(color), maps


def _recoloured(color: UInt8Array, rng: np.random.Generator) -> UInt8Array:
    """Change brightness, gamma, saturation and white balance by one table per channel."""
    if rng.random() < 0.3:
        return color
    gamma, gain = np.exp(rng.normal(0, 0.3)), np.exp(rng.normal(0, 0.2))
    ramp = np.linspace(0, 1, 256) ** gamma
    tint = np.exp(rng.normal(0, 0.06, 3)) * gain
    table = np.clip(255 * ramp[:, None] * tint, 0, 255).astype(np.uint8)
    changed = np.asarray(cv2.LUT(color, table[None])).astype(np.uint8)
    if rng.random() < 0.3:
        grey = changed.mean(axis=2, keepdims=True)
        keep = rng.uniform(0.0, 1.4)
        changed = np.clip(grey + keep * (changed - grey), 0, 255).astype(np.uint8)
    return changed
