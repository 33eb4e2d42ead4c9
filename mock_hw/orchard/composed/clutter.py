"""The 2-D compositor: what stands behind and before a tree, and is no branch of it.

All pictures are (H, W, 3) float32 linear light; a Layer lies over what is behind it.
"""

from dataclasses import dataclass

import cv2
import numpy as np

from canopy_skel.frame import Float32Array
from canopy_skel.geometry import BoolArray, FloatArray

Size = tuple[int, int]
_BARKY = np.array([0.17, 0.14, 0.115])


@dataclass(frozen=True, kw_only=True, eq=False, slots=True)
class Layer:
    """Colour and (H, W) opacity of something before or behind the tree."""

    rgb: Float32Array
    alpha: Float32Array

    def over(self, picture: Float32Array) -> Float32Array:
        """Return the picture with this layer before it."""
        alpha = self.alpha[..., None]
        return picture + alpha * (self.rgb - picture)


def clouds(rng: np.random.Generator, size: Size, cells: float, octaves: int = 4) -> Float32Array:
    """Return (H, W) smooth noise in about [0, 1] with `cells` cells across."""
    height, width = size
    total, weight = np.zeros(size, dtype=np.float32), 0.0
    for octave in range(octaves):
        across = max(int(cells * 2**octave), 2)
        if octave and across > width:
            break
        across = min(across, width)
        grid = rng.random((max(across * height // width, 2), across), dtype=np.float32)
        share = 0.55**octave
        total += share * cv2.resize(grid, (width, height), interpolation=cv2.INTER_CUBIC)
        weight += share
    return np.asarray(total / weight, dtype=np.float32)


def _two_tone(
    rng: np.random.Generator, size: Size, low: FloatArray, high: FloatArray
) -> Float32Array:
    mix = np.clip(1.8 * (clouds(rng, size, rng.uniform(2, 30)) - 0.5) + 0.5, 0, 1)[..., None]
    grain = 1 + rng.uniform(0.1, 0.9) * (clouds(rng, size, rng.uniform(60, 300)) - 0.5)
    return np.asarray((low + mix * (high - low)) * grain[..., None], dtype=np.float32)


def ground(rng: np.random.Generator, size: Size) -> Float32Array:
    """Return grass, soil, leaf litter, a wall or any two colours."""
    tones = np.array(
        [[0.075, 0.125, 0.03], [0.15, 0.11, 0.075], [0.2, 0.19, 0.17], [0.05, 0.08, 0.035]]
    )
    if rng.random() < 0.3:
        tones = rng.uniform(0.01, 0.8, (2, 1)) * np.exp(rng.normal(0, 0.35, (2, 3)))
    low, high = tones[rng.integers(len(tones), size=2)] * np.exp(rng.normal(0, 0.4, (2, 1)))
    return _two_tone(rng, size, low, high)


def sky(rng: np.random.Generator, size: Size) -> Float32Array:
    """Return a sky, clear to overcast, brighter towards a horizon that may be out of view."""
    tops = np.array([[0.25, 0.42, 0.9], [0.75, 0.8, 0.9], [1.4, 1.4, 1.4], [0.02, 0.03, 0.05]])
    top = tops[rng.integers(len(tops))] * np.exp(rng.normal(0, 0.3))
    rim = top * rng.uniform(0.9, 2.0) + rng.uniform(0, 0.5)
    down = np.linspace(rng.uniform(-0.2, 0.4), rng.uniform(0.6, 1.4), size[0]).clip(0, 1)
    picture = top + down[:, None, None] * (rim - top)
    cloud = np.clip((clouds(rng, size, rng.uniform(1, 5)) - rng.uniform(0.4, 0.9)) * 4, 0, 1)
    white = float(picture.max()) * rng.uniform(0.9, 1.4)
    return np.asarray(picture + cloud[..., None] * (white - picture), dtype=np.float32)


def _strokes(
    rng: np.random.Generator, size: Size, count: int, widths: tuple[float, float]
) -> Layer:
    """Return crooked strokes like thin trunks, limbs and twigs, each of one colour."""
    rgb, alpha = np.zeros((*size, 3), np.float32), np.zeros(size, np.float32)
    upright = rng.random() < 0.6
    for _ in range(count):
        width = int(np.exp(rng.uniform(*np.log(widths))))
        angle = rng.normal(np.pi / 2, 0.45 if upright else 2.0)
        steps = int(rng.integers(4, 16))
        turns = angle + np.cumsum(rng.normal(0, 0.16, steps))
        step = np.exp(rng.uniform(np.log(8), np.log(70)))
        line = rng.uniform([0, 0], [size[1], size[0]]) + np.cumsum(
            step * np.stack([np.cos(turns), -np.sin(turns)], axis=1), axis=0
        )
        tone = _BARKY * np.exp(rng.normal(0, 0.6)) * np.exp(rng.normal(0, 0.1, 3))
        points = [np.rint(line * 8).astype(np.int32)]
        cv2.polylines(rgb, points, False, tone.tolist(), width, cv2.LINE_AA, 3)
        cv2.polylines(alpha, points, False, 1.0, width, cv2.LINE_AA, 3)
    return Layer(rgb=rgb, alpha=alpha)


def _softened(layer: Layer, sigma_px: float) -> Layer:
    """Defocus a layer; colours are weighed by opacity so that no dark rim comes up."""
    if sigma_px < 0.3:
        return layer
    alpha = cv2.GaussianBlur(layer.alpha, (0, 0), sigma_px)
    rgb = cv2.GaussianBlur(layer.rgb * layer.alpha[..., None], (0, 0), sigma_px)
    rgb = rgb / np.maximum(alpha, 1e-4)[..., None]
    return Layer(rgb=np.asarray(rgb, np.float32), alpha=np.asarray(alpha, np.float32))


def _leaves(
    rng: np.random.Generator, size: Size, count: int, lengths: tuple[float, float]
) -> Layer:
    """Return leaves as pointed ovals in greens."""
    rgb, alpha = np.zeros((*size, 3), np.float32), np.zeros(size, np.float32)
    turn = np.linspace(0, 2 * np.pi, 14)
    oval = np.stack([np.cos(turn), np.sin(turn) * np.abs(np.sin(turn)) ** 0.4], axis=1)
    base = np.array([0.05, 0.12, 0.02]) * np.exp(rng.normal(0, 0.4)) * np.exp(rng.normal(0, 0.2, 3))
    for _ in range(count):
        length = np.exp(rng.uniform(*np.log(lengths)))
        c, s = np.cos(angle := rng.uniform(0, 2 * np.pi)), np.sin(angle)
        shape = oval * [length / 2, length * rng.uniform(0.1, 0.35)] @ np.array([[c, s], [-s, c]])
        points = np.rint(8 * (shape + rng.uniform([0, 0], [size[1], size[0]]))).astype(np.int32)
        tone = base * np.exp(rng.normal(0, 0.5))
        cv2.fillPoly(rgb, [points], tone.tolist(), cv2.LINE_AA, 3)
        cv2.fillPoly(alpha, [points], 1.0, cv2.LINE_AA, 3)
    return Layer(rgb=rgb, alpha=alpha)


def background(rng: np.random.Generator, size: Size, spare: Float32Array | None) -> Float32Array:
    """Return a background: sky, ground or both, then rows, twigs and foliage out of focus.

    spare: another picture, which serves as a far canopy when blurred.
    """
    picture = sky(rng, size) if rng.random() < 0.65 else ground(rng, size)
    if rng.random() < 0.45:
        horizon = int(size[0] * rng.uniform(0.3, 0.95))
        picture[horizon:] = ground(rng, size)[horizon:]
    luck = rng.random()
    if spare is not None and luck < 0.25:
        sigma = float(rng.uniform(2.5, 9))
        return np.asarray(cv2.GaussianBlur(spare[:, ::-1], (0, 0), sigma), dtype=np.float32)
    bright = float(picture.mean())
    for widths, most, chance, blur in (((5.0, 28.0), 10, 0.4, 3.0), ((1.0, 7.0), 120, 0.5, 1.0)):
        if rng.random() < chance:
            layer = _strokes(rng, size, int(rng.integers(2, most)), widths)
            haze = float(rng.uniform(0.0, 0.6))
            hazed = Layer(rgb=layer.rgb * (1 - haze) + haze * bright, alpha=layer.alpha)
            picture = _softened(hazed, float(rng.uniform(blur, 6.0))).over(picture)
    if rng.random() < 0.4:
        layer = _leaves(rng, size, int(rng.integers(20, 500)), (6.0, 50.0))
        picture = _softened(layer, float(rng.uniform(1.0, 6.0))).over(picture)
    return np.asarray(picture, dtype=np.float32)


def _bar(
    rng: np.random.Generator,
    size: Size,
    start: FloatArray,
    end: FloatArray,
    width_px: float,
    rgb: FloatArray,
) -> Layer:
    """Return a straight bar with the shading of a cylinder and some grain."""
    v, u = np.mgrid[: size[0], : size[1]].astype(np.float32)
    along = (end - start) / np.linalg.norm(end - start)
    across = (u - start[0]) * along[1] - (v - start[1]) * along[0]
    x = across / (0.5 * width_px)
    alpha = np.clip(0.5 * width_px - np.abs(across) + 0.5, 0, 1)
    alpha *= min(width_px, 1.0)
    light = 0.35 + 0.9 * np.sqrt(np.clip(1 - (x - rng.uniform(-0.7, 0.7)) ** 2, 0, 1))
    if width_px > 6:
        grain = clouds(rng, size, rng.uniform(20, 200), 3)
        light = light * (1 + rng.uniform(0, 0.8) * (grain - 0.5))
    return Layer(
        rgb=np.asarray(light[..., None] * rgb, np.float32), alpha=np.asarray(alpha, np.float32)
    )


_HARDWARE = {
    "wire": ((0.8, 4.0), 0.12, ((0.30, 0.30, 0.31), (0.6, 0.6, 0.6), (0.08, 0.07, 0.06))),
    "drip": ((4.0, 16.0), 0.08, ((0.012, 0.012, 0.013), (0.06, 0.05, 0.04))),
    "stake": ((6.0, 26.0), 0.5, ((0.30, 0.22, 0.10), (0.07, 0.15, 0.06), (0.28, 0.28, 0.29))),
    "post": ((28.0, 130.0), 0.06, ((0.26, 0.23, 0.19), (0.33, 0.32, 0.31), (0.2, 0.14, 0.08))),
}


def hardware(rng: np.random.Generator, size: Size, kind: str) -> Layer:
    """Return a trellis wire, drip line, stake or post right across the picture."""
    widths, slant, tones = _HARDWARE[kind]
    height, width = size
    middle = rng.uniform([0, 0], [width, height])
    angle = rng.normal(0.0 if kind in ("wire", "drip") else np.pi / 2, slant)
    reach = np.array([np.cos(angle), np.sin(angle)]) * (height + width)
    tone = np.array(tones[int(rng.integers(len(tones)))]) * np.exp(rng.normal(0, 0.35))
    thick = float(np.exp(rng.uniform(*np.log(widths))))
    return _bar(rng, size, middle - reach, middle + reach, thick, tone)


def ties(rng: np.random.Generator, wood: BoolArray, count: int) -> Layer:
    """Return short bands of plastic or cloth lying on wood."""
    rgb, alpha = np.zeros((*wood.shape, 3), np.float32), np.zeros(wood.shape, np.float32)
    places = np.argwhere(wood)
    for _ in range(count if len(places) else 0):
        v, u = places[int(rng.integers(len(places)))]
        box = (float(u), float(v)), rng.uniform([5, 10], [16, 60]).tolist(), rng.uniform(0, 180)
        corners = [np.rint(8 * cv2.boxPoints(box)).astype(np.int32)]
        tone = rng.uniform(0.01, 0.7) * np.exp(rng.normal(0, 0.5, 3))
        cv2.fillPoly(rgb, corners, tone.tolist(), cv2.LINE_AA, 3)
        cv2.fillPoly(alpha, corners, 1.0, cv2.LINE_AA, 3)
    return Layer(rgb=rgb, alpha=alpha)


def foreground(rng: np.random.Generator, wood: BoolArray, often: float = 1.0) -> list[Layer]:
    """Draw what stands between camera and tree.

    wood: (H, W), where ties may be. often: how many times as often as usual there is hardware.
    """
    layers = []
    size = wood.shape[0], wood.shape[1]
    for kind, chance in (("wire", 0.25), ("drip", 0.15), ("stake", 0.12), ("post", 0.07)):
        while rng.random() < chance * often:
            layers.append(_softened(hardware(rng, size, kind), float(rng.uniform(0, 0.8))))
    if rng.random() < 0.15:
        layers.append(ties(rng, wood, int(rng.integers(1, 6))))
    if rng.random() < 0.2:
        leaves = _leaves(rng, size, int(rng.integers(1, 25)), (30.0, 260.0))
        layers.append(_softened(leaves, float(rng.uniform(0.5, 9.0))))
    return layers


def dapple(rng: np.random.Generator, size: Size) -> Float32Array:
    """Return (H, W) light and shade as leaves throw it on bark."""
    field = clouds(rng, size, rng.uniform(12, 60), 2)
    sharp = rng.uniform(6, 40)
    shade = 1 / (1 + np.exp(-sharp * (field - rng.uniform(0.35, 0.65))))
    dark = rng.uniform(0.2, 0.7)
    return np.asarray(dark + (1 - dark) * shade, dtype=np.float32)


def strange_background(rng: np.random.Generator, size: Size) -> Float32Array:
    """Return a background of a kind `background` never draws, to validate on: net, wall, cells."""
    picture = _two_tone(rng, size, rng.uniform(0.02, 0.6, 3), rng.uniform(0.02, 0.9, 3))
    v, u = np.mgrid[: size[0], : size[1]].astype(np.float32)
    luck = rng.random()
    if luck < 0.35:
        mesh = rng.uniform(5, 22)
        c, s = np.cos(angle := rng.uniform(0, np.pi)), np.sin(angle)
        knots = np.minimum(np.mod(c * u + s * v, mesh), np.mod(c * v - s * u, mesh * 1.3))
        return np.asarray(picture * (0.35 + 0.65 * (knots > 1.4))[..., None], np.float32)
    if luck < 0.65:
        high, wide = rng.uniform(12, 40), rng.uniform(30, 110)
        course = np.floor(v / high)
        joint = (np.mod(v, high) < 2.5) | (np.mod(u + 0.5 * wide * course, wide) < 2.5)
        tone = 0.7 + 0.6 * np.mod(course * 0.618 + np.floor(u / wide) * 0.382, 1.0)
        return np.asarray(picture * np.where(joint, 0.6, tone)[..., None], np.float32)
    seeds = rng.uniform([0, 0], [size[1], size[0]], (int(rng.integers(60, 700)), 2)).astype(int)
    marks = np.full(size, 255, np.uint8)
    marks[seeds[:, 1], seeds[:, 0]] = 0
    away, cell = cv2.distanceTransformWithLabels(marks, cv2.DIST_L2, 5)
    tones = np.exp(rng.normal(0, 0.5, int(cell.max()) + 1)).astype(np.float32)
    return np.asarray(picture * (tones[cell] / (1 + 0.01 * away))[..., None], np.float32)


def banded(rng: np.random.Generator, size: Size) -> Float32Array:
    """Return (H, W) bands across, as on cherry or birch bark, which no training tree has."""
    grid = rng.random((size[0] // int(rng.integers(3, 9)), max(int(rng.integers(4, 30)), 2)))
    bands = cv2.resize(grid.astype(np.float32), (size[1], size[0]), interpolation=cv2.INTER_LINEAR)
    dark = rng.uniform(0.25, 0.8)
    return np.asarray(dark + (1 - dark) * (bands > rng.uniform(0.3, 0.6)), dtype=np.float32)
