"""Wood outside the instance masks: what is too small or too thin for a mask of its own."""

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import cv2
import numpy as np
from scipy.ndimage import gaussian_filter

from canopy_skel.frame import Float32Array, View
from canopy_skel.geometry import BoolArray
from canopy_skel.pieces import Regions, depth_of


@dataclass(frozen=True, kw_only=True, slots=True)
class FragmentConfig:
    """What counts as a fragment.

    Pixels outside the masks with a wood probability of at least `min_probability`, connected, at
    least `min_px`. They count within `margin_m` of the depths the masks span, so that rows behind
    stay out. Colours are told apart in Lab bins after smoothing; `shrink_px` pixels of
    nothing-known are added to each, so that a colour seldom seen says little.
    """

    min_probability: float = 0.6
    blur_px: int = 3
    min_px: int = 14
    max_px: int = 4000
    margin_m: float = 0.3
    shrink_px: float = 2.0


@runtime_checkable
class WoodDetector(Protocol):
    """A segmenter that also says for every pixel how likely it is wood."""

    def wood_probability(self, view: View) -> Float32Array:
        """Return (H, W) probabilities of wood, at even odds between wood and all else."""
        ...


def wood_of(segmenter: object, view: View) -> Float32Array | None:
    """Return the wood probability (H, W) of a segmenter that has one, else None."""
    return segmenter.wood_probability(view) if isinstance(segmenter, WoodDetector) else None


def mask_image(view: View, regions: Regions) -> BoolArray:
    """Return (H, W): whether some mask covers the pixel."""
    covered = np.zeros(view.color_rgb.shape[:2], dtype=np.bool_)
    covered[regions.v, regions.u] = True
    return covered


def colour_wood_probability(view: View, covered: BoolArray, config: FragmentConfig) -> Float32Array:
    """Return (H, W) wood probabilities by colour, learned from the view's own masks.

    Wood is what the masks cover, the rest is taken for not wood; only pixels at the depths of the
    tree are asked, the others are 0. One view alone, so that no other view changes its fragments.
    """
    near = at_tree(view, covered, config)
    probability = np.zeros(covered.shape, dtype=np.float32)
    wood = near & covered
    other = near & ~covered
    if not wood.any() or not other.any():
        return probability
    lab = cv2.cvtColor(view.color_rgb, cv2.COLOR_RGB2Lab)
    bins = (
        (lab[..., 0].astype(np.int32) >> 3 << 12)
        | (lab[..., 1].astype(np.int32) >> 2 << 6)
        | (lab[..., 2].astype(np.int32) >> 2)
    )
    of_wood, of_other = (_histogram(bins[chosen]) for chosen in (wood, other))
    known = config.shrink_px * (of_wood + of_other) / (of_wood.sum() + of_other.sum()) + 1e-9
    share_wood = (of_wood + known) / (of_wood.sum() + known.sum())
    share_other = (of_other + known) / (of_other.sum() + known.sum())
    log_odds = np.log(share_wood / share_other).astype(np.float32).ravel()
    # A pixel's neighbours are mostly what it is; noise is not.
    size = (config.blur_px, config.blur_px)
    asked = cv2.blur(other.astype(np.float32), size)
    mean = cv2.blur(np.where(other, log_odds[bins], np.float32(0)), size)[other] / asked[other]
    probability[other] = 1.0 / (1.0 + np.exp(-mean))
    return probability


def at_tree(view: View, covered: BoolArray, config: FragmentConfig) -> BoolArray:
    """Say which pixels (H, W) lie at the depths that the masks span, give or take the margin."""
    depth_m = depth_of(view)
    masked = depth_m[covered & np.isfinite(depth_m)]
    if len(masked) == 0:
        return np.zeros(covered.shape, dtype=np.bool_)
    low, high = np.percentile(masked, [2, 98])
    with np.errstate(invalid="ignore"):
        return np.asarray((depth_m >= low - config.margin_m) & (depth_m <= high + config.margin_m))


def fragments_of(probability: Float32Array, config: FragmentConfig) -> Regions:
    """Return the connected components of probable wood, in raster order."""
    wood = (probability >= config.min_probability).astype(np.uint8)
    count, labels, stats, _ = cv2.connectedComponentsWithStats(wood, connectivity=8)
    area = stats[:, cv2.CC_STAT_AREA]
    kept = (area >= config.min_px) & (area <= config.max_px)
    kept[0] = False
    number = np.zeros(count, dtype=np.int64)
    number[kept] = np.arange(1, kept.sum() + 1)
    v, u = np.nonzero(wood)
    of = number[labels[v, u]]
    v, u, of = v[of > 0], u[of > 0], of[of > 0]
    order = np.argsort(of, kind="stable")
    sizes = area[kept].astype(np.int64)
    start = np.concatenate([[0], np.cumsum(sizes)])
    v, u = v[order].astype(np.int64), u[order].astype(np.int64)
    mean = (
        np.add.reduceat(probability[v, u].astype(np.float64), start[:-1]) / sizes
        if len(sizes)
        else np.zeros(0)
    )
    return Regions(u=u, v=v, start=start, confidence=mean, numbers=np.zeros(len(sizes), np.int64))


def _histogram(bins: np.ndarray) -> np.ndarray:
    counts = np.bincount(bins, minlength=1 << 17).reshape(32, 64, 64).astype(np.float64)
    return np.asarray(gaussian_filter(counts, 1.0, mode="nearest"))
