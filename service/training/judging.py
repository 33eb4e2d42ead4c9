"""How good weights are on labelled pictures, and how their scores are made honest."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import minimize
from scipy.special import expit

from canopy_skel.frame import Float32Array
from canopy_skel.geometry import FloatArray
from canopy_skel.metrics.segmentation import (
    Judgement,
    SegmentationScores,
    judge,
    segmentation_scores,
)
from canopy_skel.segmenters.labels import LabelledImage
from canopy_skel.segmenters.unet.grouping import Calibration, Grouping, grouped
from canopy_skel.segmenters.unet.segmenter import masks_of

_RIDGE = 1e-3


@dataclass(frozen=True, kw_only=True, eq=False, slots=True)
class Sighting:
    """What was found in one picture, however low its score.

    features: (N, F) of the instances of `judgement`.
    """

    judgement: Judgement
    features: FloatArray


def sight(
    maps: Float32Array,
    image: LabelledImage,
    grouping: Grouping,
    calibration: Calibration,
    least_score: float,
) -> Sighting:
    """Group the maps of a picture and compare what comes of it with the labels."""
    strands = grouped(maps, grouping)
    scores = calibration.scores(strands.features)
    size = image.ignore.shape[0], image.ignore.shape[1]
    masks = masks_of(strands, scores, size, least_score=0.0)
    own = np.array([mask.instance - 1 for mask in masks], dtype=np.int64)
    judgement = judge(masks, image, threshold=least_score)
    return Sighting(judgement=judgement, features=strands.features[own[judgement.place]])


def figures(sightings: Sequence[Sighting]) -> SegmentationScores:
    """Return the figures of merit over all pictures."""
    return segmentation_scores([sighting.judgement for sighting in sightings])


def rescored(sightings: Sequence[Sighting], calibration: Calibration) -> list[Sighting]:
    """Return sightings with other scores; what was matched with what stays."""
    return [
        replace(s, judgement=replace(s.judgement, confidence=calibration.scores(s.features)))
        for s in sightings
    ]


def calibrated(sightings: Sequence[Sighting]) -> Calibration:
    """Return the logistic regression of being matched on the features (ridge, standardised).

    Where nothing was found, it says one half of everything.
    """
    x = np.concatenate([s.features for s in sightings])
    if not len(x):
        return Calibration(weights=(0.0,) * x.shape[1], bias=0.0)
    y = np.concatenate([s.judgement.at_line for s in sightings]).astype(np.float64)
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


def threshold(sightings: Sequence[Sighting], precision: float) -> float:
    """Return the lowest score from which on as large a share is wood, in steps of 0.01."""
    scores = np.concatenate([s.judgement.confidence for s in sightings])
    on_wood = np.concatenate([s.judgement.on_wood for s in sightings])
    for least in np.arange(0.05, 0.96, 0.01):
        sure = scores >= least
        if not sure.any() or on_wood[sure].mean() >= precision:
            return round(float(least), 2)
    return 0.95
