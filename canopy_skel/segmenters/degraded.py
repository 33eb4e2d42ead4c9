"""Masks made worse on purpose: what a network misses, and what it takes for branches."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from canopy_skel.frame import View
from canopy_skel.geometry import BoolArray, FloatArray
from canopy_skel.segment import BranchMask, Segmenter

SHORTEST_PX, LONGEST_PX = 30.0, 300.0
WIRE_PX = 180.0
WIDTH_PX = (4, 12)
GREENER = 1.12
FARTHER = 1.25
MOST_OVERLAP = 0.02
KINDS = {"leaf": 0.6, "wire": 0.2, "background": 0.2}
"""What false branches are, and how much of them; what a picture lacks, others make up for."""


@dataclass(frozen=True, kw_only=True, eq=False, slots=True)
class DegradedSegmenter:
    """Drops some of another segmenter's instances and adds false ones; same seed, same masks.

    Dropped ones are drawn evenly and anew in every view. False ones lie where nothing was found,
    along straight edges of the picture that are green (leaves), long (wires) or well behind the
    tree (background): slender, with scores like those of small branches. They keep the view's
    depth, so the method can still find out by itself.

    inner: whose masks. drop_share: of its instances, 0 to 1. false_share: how many false ones per
    instance it found (fewer where the picture has no more such edges).
    """

    inner: Segmenter
    drop_share: float
    false_share: float
    seed: int = 0

    def segment(self, view: View) -> Sequence[BranchMask]:
        """Return what is left of the inner masks, then the false ones.

        Raises:
            ViewError: the inner segmenter cannot use the view.
        """
        masks = self.inner.segment(view)
        rng = np.random.default_rng([self.seed, view.index, 1])
        kept = np.sort(rng.permutation(len(masks))[round(self.drop_share * len(masks)) :])
        wanted = round(self.false_share * len(masks))
        if wanted == 0:
            return [masks[i] for i in kept]
        rng = np.random.default_rng([self.seed, view.index, 2])
        first = 1 + max((mask.instance for mask in masks), default=0)
        return [masks[i] for i in kept] + false_branches(view, masks, wanted, first, rng)


@dataclass(frozen=True, kw_only=True, eq=False, slots=True)
class _Stroke:
    """A slender region that is no branch: its bounding box's corner, its mask, its kind."""

    left_px: int
    top_px: int
    mask: BoolArray
    length_px: float
    kind: str

    @property
    def box(self) -> tuple[slice, slice]:
        """Where the mask lies in the picture."""
        height, width = self.mask.shape
        return np.s_[self.top_px : self.top_px + height, self.left_px : self.left_px + width]


def false_branches(
    view: View, masks: Sequence[BranchMask], count: int, first: int, rng: np.random.Generator
) -> list[BranchMask]:
    """Return up to `count` instances where there is no branch, numbered from `first`.

    Longer edges are likelier to be taken, as a network is likelier to fall for them.
    """
    found = _painted(view, masks)
    strokes = _confusing_strokes(view, found, rng)
    false: list[BranchMask] = []
    if not strokes:
        return false
    for i in rng.choice(len(strokes), len(strokes), replace=False, p=_weights(strokes)):
        stroke = strokes[i]
        luck = rng.normal(0.0, 0.08)
        if len(false) == count or found[stroke.box][stroke.mask].mean() > MOST_OVERLAP:
            continue
        found[stroke.box] |= stroke.mask
        score = 0.55 + 0.05 * np.log(stroke.mask.sum() / 150.0) + luck
        false.append(
            BranchMask(
                instance=first + len(false),
                left_px=stroke.left_px,
                top_px=stroke.top_px,
                mask=stroke.mask,
                confidence=round(float(np.clip(score, 0.3, 0.95)), 3),
            )
        )
    return false


def _weights(strokes: Sequence[_Stroke]) -> FloatArray:
    """Return the chance of each stroke: the share of its kind, within it by length."""
    length = np.array([stroke.length_px for stroke in strokes])
    kind = np.array([stroke.kind for stroke in strokes])
    weight = np.zeros(len(strokes))
    for name, part in KINDS.items():
        weight[kind == name] = (
            part * length[kind == name] / max(float(length[kind == name].sum()), 1e-9)
        )
    return np.asarray(weight / weight.sum())


def _confusing_strokes(view: View, found: BoolArray, rng: np.random.Generator) -> list[_Stroke]:
    """Return strokes along edges of leaves, wires and background; not wood that nobody marked."""
    tree_m = _far_side_m(view, found)
    strokes = []
    for line in straight_edges(view):
        left, top, mask = _drawn(line, int(rng.integers(*WIDTH_PX, endpoint=True)), found.shape)
        length = float(np.linalg.norm(line[2:] - line[:2]))
        stroke = _Stroke(left_px=left, top_px=top, mask=mask, length_px=length, kind="leaf")
        kind = _kind_of(view, stroke, tree_m)
        if mask.any() and kind is not None:
            strokes.append(replace(stroke, kind=kind))
    return strokes


def straight_edges(view: View) -> FloatArray:
    """Return the straight edges (N, 4) of the picture as x0, y0, x1, y1 in pixels."""
    gray = np.asarray(cv2.cvtColor(view.color_rgb, cv2.COLOR_RGB2GRAY), dtype=np.uint8)
    detector = cv2.createLineSegmentDetector(cv2.LSD_REFINE_STD)
    found: object = detector.detect(gray)[0]
    if found is None:  # There is no edge at all; the library's types do not say so.
        return np.zeros((0, 4))
    lines = np.asarray(found, dtype=np.float64).reshape(-1, 4)
    offset = lines[:, 2:] - lines[:, :2]
    length = np.linalg.norm(offset, axis=1)
    shrink = np.minimum(1.0, LONGEST_PX / np.maximum(length, 1e-9))
    lines[:, 2:] = lines[:, :2] + offset * shrink[:, None]
    return np.asarray(lines[length >= SHORTEST_PX])


def _painted(view: View, masks: Sequence[BranchMask]) -> BoolArray:
    """Return (H, W) where some mask is, with a margin of three pixels."""
    found = np.zeros(view.color_rgb.shape[:2], dtype=np.uint8)
    for mask in masks:
        height, width = mask.mask.shape
        found[mask.top_px : mask.top_px + height, mask.left_px : mask.left_px + width] |= mask.mask
    grown = cv2.dilate(found, np.ones((7, 7), dtype=np.uint8))
    return np.asarray(grown, dtype=np.bool_)


def _far_side_m(view: View, found: BoolArray) -> float:
    """Return the depth that most of the found wood is nearer than; inf where none is known."""
    if view.depth_m is None:
        return float("inf")
    depth_m = view.depth_m[found]
    depth_m = depth_m[np.isfinite(depth_m)]
    return float(np.percentile(depth_m, 90)) if len(depth_m) else float("inf")


def _drawn(line: FloatArray, width: int, shape: tuple[int, ...]) -> tuple[int, int, BoolArray]:
    """Return left, top and the (h, w) mask of a stroke of this width, cut to the picture."""
    height_px, width_px = shape
    low = np.maximum(np.floor(np.minimum(line[:2], line[2:])).astype(int) - width, 0)
    high = np.ceil(np.maximum(line[:2], line[2:])).astype(int) + width + 1
    high = np.minimum(high, [width_px, height_px])
    canvas = np.zeros((max(high[1] - low[1], 1), max(high[0] - low[0], 1)), dtype=np.uint8)
    a, b = np.round(line[:2] - low).astype(int), np.round(line[2:] - low).astype(int)
    cv2.line(canvas, (int(a[0]), int(a[1])), (int(b[0]), int(b[1])), 1, width)
    return int(low[0]), int(low[1]), canvas.astype(np.bool_)


def _kind_of(view: View, stroke: _Stroke, tree_m: float) -> str | None:
    if view.depth_m is not None:
        depth_m = view.depth_m[stroke.box][stroke.mask]
        depth_m = depth_m[np.isfinite(depth_m)]
        if len(depth_m) > 0 and float(np.median(depth_m)) > FARTHER * tree_m:
            return "background"
    red, green, blue = view.color_rgb[stroke.box][stroke.mask].astype(np.float64).mean(axis=0)
    if green > GREENER * max(red, blue):
        return "leaf"
    return "wire" if stroke.length_px >= WIRE_PX else None
