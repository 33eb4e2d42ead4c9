"""What a stereo camera makes of a true depth image."""

from dataclasses import dataclass

import cv2
import numpy as np
from scipy.special import ndtri

from canopy_skel.frame import Float32Array
from canopy_skel.geometry import BoolArray, FloatArray
from mock_hw.orchard.mesh import Kind, UInt8Array

_WOODY = (Kind.WOOD, Kind.POST, Kind.WIRE, Kind.FAR_WOOD)


@dataclass(frozen=True, kw_only=True, slots=True)
class StereoNoise:
    """Error model of a stereo matcher, in pixels of disparity and shares of pixels.

    Shares hold where the effect can occur: `nearer` and `mixed` within `edge_px` behind a depth
    edge, `false_sky` in the sky there. Wood thinner than `thin_m` (radius) loses more to holes.
    """

    wood_px: float = 0.25
    leaf_px: float = 0.4
    correlation_px: int = 5
    step_px: float = 1 / 8
    hole_share: float = 0.05
    thin_hole_share: float = 0.15
    thin_m: float = 0.004
    hole_size_px: float = 2.5
    edge_px: int = 3
    edge_jump_px: float = 1.5
    nearer: float = 0.5
    mixed: float = 0.05
    false_sky: float = 0.25
    nearest_m: float = 0.35
    farthest_m: float = 12.0


@dataclass(frozen=True, kw_only=True, eq=False, slots=True)
class TrueDepth:
    """What the matcher looks at: left_m, right_m (H, W) depth of either eye, inf in the sky.

    kind: (H, W) of `Kind`; thin: (H, W) wires, and wood thinner than the model's `thin_m`.
    focal_baseline: f in pixels times the baseline in metres.
    """

    left_m: FloatArray
    right_m: FloatArray
    kind: UInt8Array
    thin: BoolArray
    focal_baseline: float


def stereo_depth(
    true: TrueDepth, rng: np.random.Generator, noise: StereoNoise | None = None
) -> Float32Array:
    """Return the (H, W) depth a stereo camera reports, NaN = no return."""
    noise = noise or StereoNoise()
    disparity = true.focal_baseline / true.left_m
    hidden = _hidden_from_right(disparity, true.focal_baseline / true.right_m)
    disparity = _smeared_edges(disparity, rng, noise)
    sigma = np.where(np.isin(true.kind, _WOODY), noise.wood_px, noise.leaf_px)
    disparity = disparity + (disparity > 0) * sigma * _correlated(true.left_m.shape, rng, noise)
    disparity = np.rint(disparity / noise.step_px) * noise.step_px
    holes = _blobs(true.left_m.shape, rng, noise.hole_size_px)
    limit = np.where(true.thin, ndtri(1 - noise.thin_hole_share), ndtri(1 - noise.hole_share))
    low, high = true.focal_baseline / noise.farthest_m, true.focal_baseline / noise.nearest_m
    lost = hidden | (holes > limit) | (disparity < low) | (disparity > high)
    disparity[lost] = np.nan
    return np.asarray(true.focal_baseline / disparity).astype(np.float32)


def perfect_depth(left_m: FloatArray) -> Float32Array:
    """Return the true depth, NaN in the sky."""
    return np.where(np.isinf(left_m), np.nan, left_m).astype(np.float32)


def _hidden_from_right(disparity: FloatArray, right_disparity: FloatArray) -> BoolArray:
    """Return where something nearer stands in the right eye's way, or its image has ended."""
    height, width = disparity.shape
    column = np.rint(np.arange(width) - disparity).astype(np.int64)
    outside = column < 0
    rows = np.arange(height)[:, None]
    there = right_disparity[rows, np.maximum(column, 0)]
    return np.asarray((outside | (there > disparity + 1.0)) & (disparity > 0))


def _smeared_edges(
    disparity: FloatArray, rng: np.random.Generator, noise: StereoNoise
) -> FloatArray:
    """Fatten near surfaces: a matching window straddles the edge."""
    size = 2 * noise.edge_px + 1
    nearer = cv2.dilate(disparity, np.ones((size, size), np.uint8)).astype(np.float64)
    edge = nearer - disparity > noise.edge_jump_px
    sky = disparity == 0
    luck = rng.random(disparity.shape)
    take = edge & (luck < np.where(sky, noise.false_sky, noise.nearer))
    mix = edge & ~sky & ~take & (luck < noise.nearer + noise.mixed)
    share = rng.random(disparity.shape)
    mixed = share * nearer + (1 - share) * disparity
    return np.where(take, nearer, np.where(mix, mixed, disparity))


def _correlated(shape: tuple[int, ...], rng: np.random.Generator, noise: StereoNoise) -> FloatArray:
    """Return unit normal noise, averaged over a square window."""
    size = noise.correlation_px
    field = cv2.blur(rng.standard_normal(shape), (size, size), borderType=cv2.BORDER_REFLECT)
    return np.asarray(field * size, dtype=np.float64)


def _blobs(shape: tuple[int, ...], rng: np.random.Generator, size_px: float) -> FloatArray:
    """Return a smooth field with unit normal marginals."""
    field = cv2.GaussianBlur(rng.standard_normal(shape), (0, 0), size_px)
    return np.asarray(field * (2 * np.sqrt(np.pi) * size_px), dtype=np.float64)
