"""Probabilities that mean what they say: logistic models, fitted on simulated trees."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import cache
from importlib.resources import files
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import ArrayLike

from canopy_skel.geometry import FloatArray

MODELS_FILE = "canopy-confidence.json"
Masks = Literal["recorded", "learned"]
"""Where masks come from: recorded beside the pictures and hardly ever wrong, or from a network."""
Depth = Literal["camera", "stereo"]
"""Where depth comes from: measured by the camera, or matched from its stereo pairs."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Logistic:
    """p = 1 / (1 + exp(-(bias + weights · (x - means) / scales)))."""

    bias: float
    weights: tuple[float, ...]
    means: tuple[float, ...]
    scales: tuple[float, ...]

    def __call__(self, features: FloatArray) -> FloatArray:
        """Return the probabilities (N,) of rows of features (N, F)."""
        standard = (features[:, : len(self.weights)] - self.means) / self.scales
        # Added up one by one: a library product may differ in the last bit with the row count.
        total = np.full(len(features), self.bias)
        for column, weight in zip(standard.T, self.weights, strict=True):
            total = total + weight * column
        return np.asarray(1.0 / (1.0 + np.exp(-np.clip(total, -30.0, 30.0))))


def fit_logistic(features: FloatArray, right: ArrayLike, ridge: float = 1.0) -> Logistic:
    """Fit by Newton's method: features (N, F), right (N,) bool; `ridge` keeps weights finite.

    Nothing to learn from gives even odds.
    """
    y = np.asarray(right, dtype=np.float64)
    if len(y) == 0:
        return Logistic(bias=0.0, weights=(), means=(), scales=())
    means, scales = features.mean(axis=0), np.maximum(features.std(axis=0), 1e-6)
    design = np.column_stack([np.ones(len(y)), (features - means) / scales])
    penalty = np.full(design.shape[1], ridge)
    penalty[0] = 1e-3
    beta = np.zeros(design.shape[1])
    for _ in range(40):
        p = 1.0 / (1.0 + np.exp(-np.clip(design @ beta, -30.0, 30.0)))
        gradient = design.T @ (y - p) - penalty * beta
        hessian = (design * (p * (1.0 - p))[:, None]).T @ design + np.diag(penalty)
        step = np.linalg.solve(hessian, gradient)
        beta += np.clip(step, -2.0, 2.0)
        if np.abs(step).max() < 1e-8:
            break
    return Logistic(
        bias=round(float(beta[0]), 6),
        weights=tuple(np.round(beta[1:], 6).tolist()),
        means=tuple(np.round(means, 6).tolist()),
        scales=tuple(np.round(scales, 6).tolist()),
    )


@dataclass(frozen=True, kw_only=True, slots=True)
class Models:
    """All models of mode `canopy`, by what they judge, and where they come from.

    link judges a possible link as a whole, joint a place on a link that was made.
    """

    instance_point: Logistic
    fragment_point: Logistic
    vertex: Logistic
    link: Logistic
    joint: Logistic
    extension: Logistic
    provenance: str


ModelSets = Mapping[Masks, Mapping[Depth, Models]]


def models_from(value: Mapping[str, Any]) -> ModelSets:
    """Return the models that `models_to` wrote."""
    return {
        masks: {depth: _one_from(value[masks][depth]) for depth in get_args(Depth)}
        for masks in get_args(Masks)
    }


def _one_from(value: Mapping[str, Any]) -> Models:
    return Models(
        provenance=value["provenance"],
        **{
            name: Logistic(
                bias=value[name]["bias"],
                weights=tuple(value[name]["weights"]),
                means=tuple(value[name]["means"]),
                scales=tuple(value[name]["scales"]),
            )
            for name in Models.__slots__
            if name != "provenance"
        },
    )


def models_to(models: ModelSets) -> bytes:
    """Return the models for each kind of masks and of depth as JSON, one line per model."""

    def lines_of(one: Models) -> str:
        return _braced([(name, json.dumps(value)) for name, value in asdict(one).items()])

    kinds = [
        (masks, _braced([(depth, lines_of(one)) for depth, one in by_depth.items()]))
        for masks, by_depth in models.items()
    ]
    return (_braced(kinds) + "\n").encode()


def _braced(items: Sequence[tuple[str, str]]) -> str:
    return "{" + ",\n ".join(f"{json.dumps(name)}: {text}" for name, text in items) + "}"


@cache
def shipped_models() -> ModelSets:
    """Return the models this package ships, by where masks and depth come from."""
    return models_from(json.loads((files("canopy_skel") / "models" / MODELS_FILE).read_text()))
