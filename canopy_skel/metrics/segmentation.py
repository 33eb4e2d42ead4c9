"""How good the branch instances of a segmenter are, picture by picture: see docs/segmentation.md.

`judge` counts one picture, `segmentation_scores` makes figures of many.
"""

from collections.abc import Sequence
from dataclasses import asdict, dataclass

import numpy as np

from canopy_skel.geometry import BoolArray, FloatArray, IntArray
from canopy_skel.metrics.calibration import brier_score, expected_calibration_error
from canopy_skel.metrics.lines import LEAST_OVERLAP, MiddleLine, covered, overlaps
from canopy_skel.segment import BranchMask
from canopy_skel.segmenters.labels import LabelledImage, line_of_mask

TOLERANCE_PX = 5.0
_IGNORED = 0.5


@dataclass(frozen=True, kw_only=True, slots=True)
class SegmentationScores:
    """Figures of a segmenter on labelled pictures; None where there is nothing to take a share of.

    What is marked ignored counts nowhere: no pixel of it, no instance that is half on it and that
    no truth claims. "At the threshold" means counting only instances of that confidence or more.

    pixel_iou, pixel_precision, pixel_recall: of wood pixels at the threshold, all pictures
        together.
    cl_dice: harmonic mean of the shares of found middle lines inside true wood and of true middle
        lines inside found wood, at the threshold (Shit et al., CVPR 2021, with the instances'
        middle lines as the skeletons).
    completeness, correctness: shares, by length, of the true middle lines with a found one within
        5 pixels (or a third of the radius), and the reverse, at the threshold.
    ap30, ap50: average precision of instances matched one to one by mask IoU; area under the
        precision envelope, all confidences.
    line_ap: the same, matched by middle line: nearer than a radius and 3 pixels, less than 10
        degrees apart, more than half of the longer in common.
    precision, recall: at the threshold, matched by middle line, one to one: the pieces of a branch
        found in pieces count once.
    precision_wood: share of instances at the threshold most of whose pixels are true wood: these
        are no false branches, however they are cut.
    ece, brier: of the confidence as the chance to be matched by middle line, all confidences.
    ece_wood, brier_wood: of the confidence as the chance that most pixels are true wood, which is
        what the likelihood map takes it for.
    pictures, instances_true, instances_found, threshold: what was judged; found: at the threshold.
    """

    pixel_iou: float | None
    pixel_precision: float | None
    pixel_recall: float | None
    cl_dice: float | None
    completeness: float | None
    correctness: float | None
    ap30: float | None
    ap50: float | None
    line_ap: float | None
    precision: float | None
    recall: float | None
    precision_wood: float | None
    ece: float | None
    brier: float | None
    ece_wood: float | None
    brier_wood: float | None
    pictures: int
    instances_true: int
    instances_found: int
    threshold: float

    def to_dict(self) -> dict[str, float | int | None]:
        """Return the figures by name, ready for JSON."""
        return asdict(self)


@dataclass(frozen=True, kw_only=True, eq=False, slots=True)
class Judgement:
    """What one picture adds to the scores.

    place, confidence, at30, at50, at_line, on_wood: (N,) of the instances that count: where among
    those found, how sure, whether matched by IoU 0.3, 0.5 and by middle line, whether most pixels
    are wood. true_count: instances
    to be found. pixels: wood in both, found, true. line_px: lengths of found lines, of these
    inside true wood, of these near true lines; of true lines, of these inside found wood, of these
    near found lines.
    """

    threshold: float
    place: IntArray
    confidence: FloatArray
    at30: BoolArray
    at50: BoolArray
    at_line: BoolArray
    on_wood: BoolArray
    true_count: int
    pixels: IntArray
    line_px: FloatArray


def judge(
    found: Sequence[BranchMask], truth: LabelledImage, *, threshold: float = 0.5
) -> Judgement:
    """Compare the instances found in a picture, of all confidences, with its labels."""
    order = np.argsort([-mask.confidence for mask in found], kind="stable")
    masks = [found[place] for place in order.tolist()]
    confidence = np.array([mask.confidence for mask in masks])
    numbers = np.unique(truth.instances[truth.instances > 0]).astype(np.int64)
    shared, size, judged, ignored = _pixels_of(masks, truth)
    true_size = np.bincount(truth.instances.ravel(), minlength=shared.shape[1])
    union = judged[:, None] + true_size[None, :] - shared
    iou = (shared / np.maximum(union, 1))[:, numbers]
    lines = [MiddleLine.of(_line_of(mask)) for mask in masks]
    true_lines = [MiddleLine.of(truth.lines[number - 1]) for number in numbers.tolist()]
    common = overlaps(lines, true_lines)
    at30, at50, at_line = matched(iou, 0.3), matched(iou, 0.5), matched(common, LEAST_OVERLAP)
    counts = ~((ignored > _IGNORED * size) & ~at30 & ~at_line)
    sure = confidence >= threshold
    chosen = [place for place in range(len(masks)) if sure[place]]
    return Judgement(
        threshold=threshold,
        place=order[counts],
        confidence=confidence[counts],
        at30=at30[counts],
        at50=at50[counts],
        at_line=at_line[counts],
        on_wood=(2 * shared[:, 1:].sum(axis=1) > judged)[counts],
        true_count=len(numbers),
        **_areas([masks[k] for k in chosen], [lines[k] for k in chosen], true_lines, truth),
    )


def best_overlaps(found: Sequence[BranchMask], truth: LabelledImage) -> FloatArray:
    """Return what each mask has in common, by middle line, with the label it is most like, (N,).

    NaN where most of a mask is to be ignored and no label is its own.
    """
    _, size, _, ignored = _pixels_of(found, truth)
    numbers = np.unique(truth.instances[truth.instances > 0]).astype(np.int64)
    lines = [MiddleLine.of(_line_of(mask)) for mask in found]
    true_lines = [MiddleLine.of(truth.lines[number - 1]) for number in numbers.tolist()]
    best = overlaps(lines, true_lines).max(axis=1, initial=0.0)
    return np.asarray(np.where((ignored > _IGNORED * size) & (best <= LEAST_OVERLAP), np.nan, best))


def matched(likeness: FloatArray, least: float) -> BoolArray:
    """Say which rows (N,), first come first served, get a column of (N, M) all to themselves.

    Each row takes the free column it is most like, if that is more than `least`.
    """
    free = np.ones(likeness.shape[1], dtype=np.bool_)
    result = np.zeros(len(likeness), dtype=np.bool_)
    for row, values in enumerate(likeness):
        if not free.any():
            break
        best = int(np.where(free, values, -1.0).argmax())
        if values[best] > least:
            result[row], free[best] = True, False
    return result


def _pixels_of(
    masks: Sequence[BranchMask], truth: LabelledImage
) -> tuple[IntArray, IntArray, IntArray, IntArray]:
    """Return pixels (N, 1 + M) by true instance (0: none), in all, not ignored, and ignored."""
    width = int(truth.instances.max(initial=0)) + 1
    shared = np.zeros((len(masks), width), dtype=np.int64)
    size, ignored = (np.zeros(len(masks), dtype=np.int64) for _ in range(2))
    for row, mask in enumerate(masks):
        box = _box(mask)
        own, ignore = truth.instances[box], truth.ignore[box] & (truth.instances[box] == 0)
        judged = mask.mask & ~ignore
        shared[row] = np.bincount(own[judged], minlength=width)
        size[row] = mask.mask.sum()
        ignored[row] = size[row] - judged.sum()
    return shared, size, size - ignored, ignored


def _box(mask: BranchMask) -> tuple[slice, slice]:
    height, width = mask.mask.shape
    return (
        slice(mask.top_px, mask.top_px + height),
        slice(mask.left_px, mask.left_px + width),
    )


def _line_of(mask: BranchMask) -> FloatArray:
    if mask.mask.sum() < 2:
        return np.array([[mask.left_px, mask.top_px, 0.5]])
    return np.asarray(line_of_mask(mask.mask) + np.array([mask.left_px, mask.top_px, 0.0]))


def _areas(
    masks: list[BranchMask],
    lines: list[MiddleLine],
    true_lines: list[MiddleLine],
    truth: LabelledImage,
) -> dict[str, np.ndarray]:
    """Return what pictures add up: `pixels` and `line_px` of a Judgement."""
    wood = np.zeros(truth.instances.shape, dtype=np.bool_)
    for mask in masks:
        wood[_box(mask)] |= mask.mask
    true_wood = truth.instances > 0
    ignore = truth.ignore & ~true_wood
    wood_judged = wood & ~ignore
    pixels = [(wood_judged & true_wood).sum(), wood_judged.sum(), true_wood.sum()]
    near = covered(lines, true_lines, TOLERANCE_PX)
    near_true = covered(true_lines, lines, TOLERANCE_PX)
    total = np.zeros(6)
    for line, close in zip(lines, near, strict=True):
        weight = line.weight * ~_at(ignore, line)
        total[:3] += weight.sum(), weight[_at(true_wood, line)].sum(), weight[close].sum()
    for line, close in zip(true_lines, near_true, strict=True):
        weight = line.weight
        total[3:] += weight.sum(), weight[_at(wood, line)].sum(), weight[close].sum()
    return {"pixels": np.array(pixels, dtype=np.int64), "line_px": total}


def _at(image: BoolArray, line: MiddleLine) -> BoolArray:
    """Look up an image at a line's samples; outside it nothing is true."""
    u, v = np.rint(line.points).astype(np.int64).T
    height, width = image.shape
    inside = (u >= 0) & (u < width) & (v >= 0) & (v < height)
    return np.asarray(inside & image[np.clip(v, 0, height - 1), np.clip(u, 0, width - 1)])


def segmentation_scores(judgements: Sequence[Judgement]) -> SegmentationScores:
    """Return the figures of several pictures together."""
    threshold = judgements[0].threshold if judgements else 0.5

    def joined(name: str) -> np.ndarray:
        parts = [getattr(one, name) for one in judgements]
        return np.concatenate(parts) if parts else np.zeros(0)

    confidence = joined("confidence")
    right, on_wood = joined("at_line").astype(np.bool_), joined("on_wood").astype(np.bool_)
    one, sure = np.ones(len(confidence)), confidence >= threshold
    count = sum(judgement.true_count for judgement in judgements)
    both, found, true = (sum((j.pixels for j in judgements), np.zeros(3, np.int64))).tolist()
    px = sum((j.line_px for j in judgements), np.zeros(6)).tolist()
    return SegmentationScores(
        pixel_iou=_share(both, found + true - both),
        pixel_precision=_share(both, found),
        pixel_recall=_share(both, true),
        cl_dice=_dice(_share(px[1], px[0]), _share(px[4], px[3])),
        completeness=_share(px[5], px[3]),
        correctness=_share(px[2], px[0]),
        ap30=average_precision(confidence, joined("at30").astype(np.bool_), count),
        ap50=average_precision(confidence, joined("at50").astype(np.bool_), count),
        line_ap=average_precision(confidence, right, count),
        precision=_share(int((right & sure).sum()), int(sure.sum())),
        recall=_share(int((right & sure).sum()), count),
        precision_wood=_share(int((on_wood & sure).sum()), int(sure.sum())),
        ece=expected_calibration_error(confidence, right, one),
        brier=brier_score(confidence, right, one),
        ece_wood=expected_calibration_error(confidence, on_wood, one),
        brier_wood=brier_score(confidence, on_wood, one),
        pictures=len(judgements),
        instances_true=count,
        instances_found=int(sure.sum()),
        threshold=threshold,
    )


def average_precision(confidence: FloatArray, right: BoolArray, true_count: int) -> float | None:
    """Return the area under the envelope of precision over recall; None without any truth.

    Args:
        confidence: (N,); instances of equal confidence count as one step.
        right: (N,) whether matched.
        true_count: how many there were to find.
    """
    if true_count == 0:
        return None
    order = np.argsort(-confidence, kind="stable")
    hits = np.cumsum(right[order])
    last_of_step = np.flatnonzero(np.diff(confidence[order], append=-np.inf) != 0)
    recall = hits[last_of_step] / true_count
    precision = hits[last_of_step] / (last_of_step + 1)
    envelope = np.maximum.accumulate(precision[::-1])[::-1]
    return float(np.sum(np.diff(recall, prepend=0.0) * envelope))


def _share(part: float, whole: float) -> float | None:
    return part / whole if whole > 0 else None


def _dice(one: float | None, other: float | None) -> float | None:
    if one is None or other is None:
        return None if one is None and other is None else 0.0
    return 2 * one * other / (one + other) if one + other > 0 else 0.0
