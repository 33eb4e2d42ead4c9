"""Wood outside the instance masks: what is too small or too thin for a mask of its own."""

from dataclasses import dataclass

import cv2
import numpy as np
from scipy.ndimage import gaussian_filter

from canopy_skel.components import pixels_of, runs_of
from canopy_skel.frame import Float32Array, UInt8Array, View
from canopy_skel.geometry import BoolArray, FloatArray, IntArray
from canopy_skel.kernels import colours
from canopy_skel.pieces import Regions, depth_of
from canopy_skel.segmenters.unet.targets import STRIDE
from canopy_skel.woodpixels import MOST_LOGIT, PixelModel, hints_of, lab_of, layers_of

_SPREAD = 4
"""Colours count up to so many bins from their own."""


@dataclass(frozen=True, kw_only=True, slots=True)
class FragmentConfig:
    """What counts as a fragment.

    Pixels outside the masks with a wood probability of at least `min_probability`, connected, at
    least `min_px`. Pixels are not asked whose colour has log odds under `min_log_odds`, unless the
    network gives them a logit of `min_logit`, nor those around which it gives none of
    `min_logit_around`, where next to nothing would be found. They count within `margin_m` of the
    depths the masks span, so that rows behind stay out. Colours are told apart in Lab bins;
    `shrink_px` pixels of nothing-known are added to each, so that a colour seldom seen says little.
    """

    min_probability: float = 0.3
    min_log_odds: float = -1.0
    min_logit: float = 0.0
    min_logit_around: float = -4.0
    blur_px: int = 3
    min_px: int = 10
    max_px: int = 4000
    margin_m: float = 0.3
    shrink_px: float = 2.0


def mask_image(view: View, regions: Regions) -> BoolArray:
    """Return (H, W): whether some mask covers the pixel."""
    covered = np.zeros(view.color_rgb.shape[:2], dtype=np.bool_)
    covered[regions.v, regions.u] = True
    return covered


def wood_probability(
    view: View,
    maps: Float32Array,
    covered: BoolArray,
    config: FragmentConfig,
    model: PixelModel,
) -> Float32Array:
    """Return (H, W) wood probabilities of pixels outside the masks, 0 where nothing is asked.

    Colour, learned from the view's own masks, and the maps (8, h, w) of a network say which pixels
    to ask; the model looks at what lies around them too. One view alone, so that no other view
    changes its fragments.
    """
    probability = np.zeros(covered.shape, dtype=np.float32)
    lab = lab_of(view)
    log_odds, mean_odds = colour_log_odds(view, lab, covered, config)
    hints = hints_of(maps)
    v, u = asked_pixels(mean_odds, hints, config)
    if len(v) == 0:
        return probability
    layers = layers_of(view, lab, covered, log_odds)
    probability[v, u] = model.probability(layers, hints, mean_odds[v, u], v, u)
    return probability


def asked_pixels(
    mean_odds: Float32Array, hints: Float32Array, config: FragmentConfig
) -> tuple[IntArray, IntArray]:
    """Return rows and columns of the pixels that by colour or network may be wood.

    mean_odds: (H, W), of `colour_log_odds`. hints: (h, w, HINTS), of `hints_of`.
    """
    sure, around = hints[..., 0] >= config.min_logit, hints[..., 3] >= config.min_logit_around
    size = mean_odds.shape[::-1]
    flags = cv2.resize(sure + np.uint8(2) * around, size, interpolation=cv2.INTER_NEAREST)
    asked = (mean_odds >= config.min_log_odds) | (mean_odds > -np.inf) & (np.asarray(flags) % 2 > 0)
    v, u = np.divmod(np.flatnonzero(asked & (flags >= 2)), size[0])
    return v, u


def colour_log_odds(
    view: View, lab: UInt8Array, covered: BoolArray, config: FragmentConfig
) -> tuple[Float32Array, Float32Array]:
    """Return log odds of wood by colour (H, W), and their means among pixels that are asked.

    `lab` (H, W, 3): the picture, as `lab_of` gives it. Wood is what the masks cover, the rest is
    taken for not wood; only pixels beside the masks at the depths of the tree are asked, the means
    of others are negative infinite.
    """
    near = at_tree(view, covered, config)
    other = near & ~covered
    counts = colours.count_colours(lab, near, covered)
    if not counts.any(axis=1).all():
        nothing = np.zeros(covered.shape, dtype=np.float32)
        return nothing, np.full(covered.shape, -np.inf, dtype=np.float32)
    of_wood, of_other = map(_spread, counts)
    known = config.shrink_px * (of_wood + of_other) / (of_wood.sum() + of_other.sum()) + 1e-9
    share_wood = (of_wood + known) / (of_wood.sum() + known.sum())
    share_other = (of_other + known) / (of_other.sum() + known.sum())
    log_odds = colours.look_up(lab, np.log(share_wood / share_other).astype(np.float32).ravel())
    return log_odds, _mean_among(log_odds, other, config.blur_px)


def _mean_among(log_odds: Float32Array, chosen: BoolArray, blur_px: int) -> Float32Array:
    """Return means of chosen pixels (H, W) and the chosen around them, negative infinite elsewhere.

    A pixel's neighbours are mostly what it is; noise is not.
    """
    size, mean = (blur_px, blur_px), np.full(chosen.shape, -np.inf, dtype=np.float32)
    total = cv2.boxFilter(log_odds * chosen, -1, size, normalize=False)
    count = cv2.boxFilter(chosen.view(np.uint8), cv2.CV_32F, size, normalize=False)
    np.divide(total, count, out=mean, where=chosen)
    return mean


def at_tree(view: View, covered: BoolArray, config: FragmentConfig) -> BoolArray:
    """Say which pixels (H, W) lie at the depths that the masks span, give or take the margin."""
    depth_m = depth_of(view)
    masked = depth_m[covered]
    masked = masked[np.isfinite(masked)]
    if len(masked) == 0:
        return np.zeros(covered.shape, dtype=np.bool_)
    low, high = np.percentile(masked, [2, 98])
    return cv2.inRange(depth_m, low - config.margin_m, high + config.margin_m) > 0


def fragments_of(probability: Float32Array, maps: Float32Array, config: FragmentConfig) -> Regions:
    """Return the connected components of probable wood, in raster order of blocks of pixels.

    probability: (H, W). maps: (8, h, w) of the network, which knows where they run.
    """
    runs = runs_of(probability >= config.min_probability)
    kept = np.flatnonzero((runs.area >= config.min_px) & (runs.area <= config.max_px))
    # By the first block of 2 x 2 pixels that any pixel is in; within a component by row.
    block = (runs.row // 2) * probability.shape[1] + runs.first_px // 2
    first = np.full(len(block), probability.size)
    np.minimum.at(first, runs.component, block)
    order = kept[np.argsort(first[runs.component[kept]], kind="stable")]
    v, u = pixels_of(runs, order)
    of = runs.component[order]
    heads = np.flatnonzero(np.diff(of, prepend=-1))
    sizes = runs.area[order][heads]
    start = np.concatenate([[0], np.cumsum(sizes)])
    row = (v + 0.5) * maps.shape[1] / probability.shape[0]
    column = (u + 0.5) * maps.shape[2] / probability.shape[1]
    cells = maps[:5, row.astype(np.int64), column.astype(np.int64)]
    branch, centre = np.clip(cells[:2], -MOST_LOGIT, MOST_LOGIT)
    columns = [probability[v, u], *cells[2:4], branch, centre, cells[4]]
    each = np.column_stack(columns).astype(np.float64)
    mean, highest = np.zeros((0, 6)), np.zeros(0)
    if len(sizes):
        mean = np.add.reduceat(each, start[:-1], axis=0) / sizes[:, None]
        highest = np.maximum.reduceat(each[:, 4], start[:-1])
    return Regions(
        u=u,
        v=v,
        start=start,
        confidence=mean[:, 0],
        numbers=np.zeros(len(sizes), np.int64),
        said=np.column_stack([mean[:, 1:5], highest]),
        radius_px=np.exp(mean[:, 5]) * (probability.shape[1] / maps.shape[2] / STRIDE),
    )


def _spread(counts: IntArray) -> FloatArray:
    """Return counts of colours (32, 64, 64), each spread over the bins around its own."""
    spread = counts.reshape(32, 64, 64).astype(np.float64)
    used = np.array(np.nonzero(spread))
    # Few of the colours there are occur; beyond what is in reach of these, all is 0.
    reach = tuple(
        slice(max(low - _SPREAD, 0), high + _SPREAD + 1)
        for low, high in zip(used.min(axis=1), used.max(axis=1), strict=True)
    )
    spread[reach] = gaussian_filter(spread[reach], 1.0, mode="nearest", radius=_SPREAD)
    return spread
