"""How good weights are on labelled pictures, and how their scores are made honest."""

import copy
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.optimize import minimize
from scipy.special import expit, logit

from canopy_skel.geometry import FloatArray
from canopy_skel.metrics.segmentation import Judgement, judge
from canopy_skel.segmenters.labels import LabelledImage
from canopy_skel.segmenters.unet.scorer import Scorer
from canopy_skel.segmenters.unet.segmenter import UNetSegmenter, instances_of
from canopy_skel.segmenters.unet.weights import Model

_RIDGE = 1e-3
_SUREST = 1e-9
_LEAST_SLOPE = 0.05


class Correction(NamedTuple):
    """Of scores, on their logits."""

    slope: float
    shift: float

    def of(self, confidence: FloatArray) -> FloatArray:
        """Return corrected scores."""
        logits = logit(np.clip(confidence, _SUREST, 1 - _SUREST))
        return np.asarray(expit(self.slope * logits + self.shift))


def judgements_of(model: Model, pictures: Sequence[LabelledImage]) -> list[Judgement]:
    """Compare what a model finds, however low its score, with the labels."""
    segmenter, every = UNetSegmenter(model), replace(model, least_score=0.0)
    return [
        judge(
            instances_of(segmenter.known(picture.color_rgb), picture.ignore.shape[:2], every),
            picture,
            threshold=model.least_score,
        )
        for picture in pictures
    ]


def corrected(judgements: Sequence[Judgement], correction: Correction) -> list[Judgement]:
    """Return judgements with corrected scores; what was matched with what stays."""
    return [replace(one, confidence=correction.of(one.confidence)) for one in judgements]


def honest(judgements: Sequence[Judgement]) -> Correction:
    """Return the correction that makes scores the chance to be matched (Platt's; ridge).

    It never turns their order round. Without any instance it changes nothing.
    """
    found = np.concatenate([one.confidence for one in judgements])
    if not len(found):
        return Correction(slope=1.0, shift=0.0)
    x = logit(np.clip(found, _SUREST, 1 - _SUREST))
    y = np.concatenate([one.at_line for one in judgements]).astype(np.float64)

    def cost(parameters: FloatArray) -> tuple[float, FloatArray]:
        slope, shift = parameters
        z = slope * x + shift
        residual = (expit(z) - y) / len(y)
        value = np.mean(np.logaddexp(0, z) - y * z) + _RIDGE * ((slope - 1) ** 2 + shift**2)
        gradient = [residual @ x + 2 * _RIDGE * (slope - 1), residual.sum() + 2 * _RIDGE * shift]
        return float(value), np.array(gradient)

    bounds = [(_LEAST_SLOPE, None), (None, None)]
    start = np.array([1.0, 0.0])
    slope, shift = minimize(cost, start, jac=True, method="L-BFGS-B", bounds=bounds).x
    return Correction(slope=float(slope), shift=float(shift))


def corrected_scorer(scorer: Scorer, correction: Correction) -> Scorer:
    """Return a scorer whose scores are corrected."""
    result = copy.deepcopy(scorer)
    result.slope.mul_(correction.slope)
    result.shift.mul_(correction.slope).add_(correction.shift)
    return result


def threshold(judgements: Sequence[Judgement], precision: float) -> float:
    """Return the lowest score from which on as large a share is wood, in steps of 0.01."""
    scores = np.concatenate([one.confidence for one in judgements])
    on_wood = np.concatenate([one.on_wood for one in judgements])
    for least in np.arange(0.05, 0.96, 0.01):
        sure = scores >= least
        if not sure.any() or on_wood[sure].mean() >= precision:
            return round(float(least), 2)
    return 0.95
