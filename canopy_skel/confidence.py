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
    """p = 1 / (1 + exp(-(bias + linear · z + products · (z_i z_j)))), z = (x - means) / scales.

    Of F figures x there are F linear weights and F (F + 1) / 2 of products, of the pairs i <= j in
    the order (0, 0), (0, 1), ... No figure counts for more than `FARTHEST` scales from its mean.
    """

    bias: float
    linear: tuple[float, ...]
    products: tuple[float, ...]
    means: tuple[float, ...]
    scales: tuple[float, ...]

    def __call__(self, figures: FloatArray) -> FloatArray:
        """Return the probabilities (N,) of rows of figures (N, F).

        Raises:
            ValueError: it was fitted to another number of them.
        """
        if self.means and figures.shape[1] != len(self.means):
            raise ValueError(
                f"confidences fitted to {len(self.means)} figures, asked of {figures.shape[1]}: fit"
                " them again"
            )
        columns = _standard(figures[:, : len(self.means)], self.means, self.scales).T
        columns = np.ascontiguousarray(columns)
        # Added up one by one: a library product may differ in the last bit with the row count.
        total = np.full(len(figures), self.bias)
        weights = iter(self.products)
        for i, column in enumerate(columns):
            slope = np.full(len(figures), self.linear[i])
            for other, weight in zip(columns[i:], weights, strict=False):
                slope += weight * other
            total += column * slope
        return np.asarray(1.0 / (1.0 + np.exp(-np.clip(total, -30.0, 30.0))))


FARTHEST = 5.0
_ROWS = 20000
"""So many at once go into the sums of a fit."""


def fit_logistic(figures: FloatArray, right: ArrayLike, ridge: float = 100.0) -> Logistic:
    """Fit by Newton's method: figures (N, F), right (N,) bool; `ridge` keeps weights finite.

    Nothing to learn from gives even odds.
    """
    y = np.asarray(right, dtype=np.float64)
    if len(y) == 0:
        return Logistic(bias=0.0, linear=(), products=(), means=(), scales=())
    means, scales = figures.mean(axis=0), np.maximum(figures.std(axis=0), 1e-6)
    standard = _standard(figures, means, scales)
    count = figures.shape[1]
    penalty = np.full(1 + count + count * (count + 1) // 2, ridge)
    penalty[0] = 1e-3
    beta = np.zeros(len(penalty))
    for _ in range(40):
        gradient, hessian = -penalty * beta, np.diag(penalty)
        for first in range(0, len(y), _ROWS):
            design = _terms(standard[first : first + _ROWS])
            p = 1.0 / (1.0 + np.exp(-np.clip(design @ beta, -30.0, 30.0)))
            gradient += design.T @ (y[first : first + _ROWS] - p)
            hessian += (design * (p * (1.0 - p))[:, None]).T @ design
        step = np.linalg.solve(hessian, gradient)
        beta += np.clip(step, -2.0, 2.0)
        if np.abs(step).max() < 1e-6:
            break
    return Logistic(
        bias=_rounded(beta[:1])[0],
        linear=_rounded(beta[1 : 1 + count]),
        products=_rounded(beta[1 + count :]),
        means=_rounded(means),
        scales=_rounded(scales),
    )


def _standard(figures: FloatArray, means: ArrayLike, scales: ArrayLike) -> FloatArray:
    standard = (figures - np.asarray(means)) / np.asarray(scales)
    return np.asarray(np.clip(standard, -FARTHEST, FARTHEST))


def _terms(standard: FloatArray) -> FloatArray:
    """Return one, the figures and their products (N, 1 + F + F (F + 1) / 2)."""
    i, j = np.triu_indices(standard.shape[1])
    return np.column_stack([np.ones(len(standard)), standard, standard[:, i] * standard[:, j]])


def _rounded(values: FloatArray) -> tuple[float, ...]:
    return tuple(np.round(values, 6).tolist())


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
                linear=tuple(value[name]["linear"]),
                products=tuple(value[name]["products"]),
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
