"""How good weights are on labelled pictures, and how their scores are made honest."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from scipy.optimize import minimize
from scipy.special import expit

from canopy_skel.frame import Float32Array
from canopy_skel.geometry import BoolArray, FloatArray, IntArray
from canopy_skel.metrics.instances import (
    Judged,
    average_precision,
    calibration_error,
    judge,
    precision_and_recall,
)
from canopy_skel.segment import BranchMask
from canopy_skel.segmenters.labels import LabelledImage, line_of_mask
from canopy_skel.segmenters.unet.grouping import Calibration, Grouping, grouped
from canopy_skel.segmenters.unet.segmenter import masks_of
from canopy_skel.segmenters.unet.targets import STRIDE

_RIDGE = 1e-3


@dataclass(frozen=True, kw_only=True, eq=False, slots=True)
class Sighting:
    """What was found in one picture, however low its score.

    features: (N, F) of the instances of `judged`. common, either: (2,) pixels both found and true,
    and found or true, ignored ones left out: of the branch map, of the instances reported.
    """

    judged: Judged
    features: FloatArray
    common: IntArray
    either: IntArray


def sight(
    maps: Float32Array,
    image: LabelledImage,
    grouping: Grouping,
    calibration: Calibration,
    least_score: float,
) -> Sighting:
    """Group the maps of a picture and match what comes of it."""
    strands = grouped(maps, grouping)
    scores = calibration.scores(strands.features)
    size = image.ignore.shape[0], image.ignore.shape[1]
    masks = masks_of(strands, scores, size, least_score=0.0)
    own = np.array([mask.instance - 1 for mask in masks], dtype=np.int64)
    ignored = np.array([_ignored(mask, image.ignore) for mask in masks], dtype=bool)
    judged = judge([_line(mask) for mask in masks], scores[own], ignored, image.lines)
    true = image.instances > 0
    sure = [mask for mask in masks if mask.confidence >= least_score]
    whole = cv2.resize(maps[0], None, fx=STRIDE, fy=STRIDE)[: size[0], : size[1]] > 0
    found = [pixels & ~image.ignore for pixels in (whole, _pixels(sure, size))]
    return Sighting(
        judged=judged,
        features=strands.features[own[judged.number]],
        common=np.array([(pixels & true).sum() for pixels in found]),
        either=np.array([(pixels | true).sum() for pixels in found]),
    )


def _line(mask: BranchMask) -> FloatArray:
    return np.add(line_of_mask(mask.mask), (mask.left_px, mask.top_px, 0.0))


def _ignored(mask: BranchMask, ignore: BoolArray) -> bool:
    height, width = mask.mask.shape
    part = ignore[mask.top_px : mask.top_px + height, mask.left_px : mask.left_px + width]
    return bool(2 * (part & mask.mask).sum() > mask.mask.sum())


def _pixels(masks: Sequence[BranchMask], size: tuple[int, int]) -> BoolArray:
    out = np.zeros(size, dtype=bool)
    for mask in masks:
        height, width = mask.mask.shape
        out[mask.top_px : mask.top_px + height, mask.left_px : mask.left_px + width] |= mask.mask
    return out


def figures(sightings: Sequence[Sighting], least_score: float) -> dict[str, float]:
    """Return the figures of merit over all pictures, with what is reported at `least_score`."""
    judged = [sighting.judged for sighting in sightings]
    precision, recall = precision_and_recall(judged, least_score)
    common = np.sum([s.common for s in sightings], axis=0)
    either = np.sum([s.either for s in sightings], axis=0)
    return {
        "line_ap": average_precision(judged),
        "precision": precision,
        "recall": recall,
        "pixel_iou": float(common[0] / max(either[0], 1)),
        "pixel_iou_reported": float(common[1] / max(either[1], 1)),
        "calibration_error": calibration_error(
            np.concatenate([j.scores for j in judged]), np.concatenate([j.real for j in judged])
        ),
        "instances": float(sum(j.truths for j in judged)),
        "pictures": float(len(judged)),
    }


def calibrated(sightings: Sequence[Sighting]) -> Calibration:
    """Return the logistic regression of being real on the features (ridge, standardised)."""
    x = np.concatenate([s.features for s in sightings])
    y = np.concatenate([s.judged.real for s in sightings]).astype(np.float64)
    middle, spread = x.mean(axis=0), x.std(axis=0) + 1e-9
    z = (x - middle) / spread

    def cost(parameters: FloatArray) -> tuple[float, FloatArray]:
        logit = z @ parameters[:-1] + parameters[-1]
        value = np.mean(np.logaddexp(0, logit) - y * logit)
        residual = (expit(logit) - y) / len(y)
        slope = np.concatenate([z.T @ residual, [residual.sum()]])
        slope[:-1] += 2 * _RIDGE * parameters[:-1]
        return float(value + _RIDGE * np.sum(parameters[:-1] ** 2)), slope

    best = minimize(cost, np.zeros(x.shape[1] + 1), jac=True, method="L-BFGS-B").x
    weights = best[:-1] / spread
    return Calibration(
        weights=tuple(float(w) for w in weights), bias=float(best[-1] - weights @ middle)
    )


def threshold(judged: Sequence[Judged], precision: float) -> float:
    """Return the lowest score from which on precision is at least as wanted, in steps of 0.01."""
    for least in np.arange(0.05, 0.96, 0.01):
        if precision_and_recall(judged, float(least))[0] >= precision:
            return round(float(least), 2)
    return 0.95
