"""How likely each pixel beside the masks is wood, by what lies around it: a small shipped model."""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from typing import Any

import cv2
import numpy as np

from canopy_skel.frame import Float32Array, UInt8Array, View
from canopy_skel.geometry import BoolArray, IntArray
from canopy_skel.kernels import around
from canopy_skel.pieces import depth_of

PIXEL_MODEL_FILE = "wood-pixels.json"
_MOST_ODDS = 4.0
_BLUR_PX = 0.7
MOST_LOGIT = 8.0
_NEAR_CELLS, _AROUND_CELLS = 5, 3.75


@dataclass(frozen=True, kw_only=True, eq=False, slots=True)
class PixelModel:
    """Log odds = second_bias + max(0, first_bias + figures · first) · second.

    first: (FIGURES, K); first_bias, second: (K,). provenance: what it was fitted to.
    """

    first: Float32Array
    first_bias: Float32Array
    second: Float32Array
    second_bias: float
    provenance: str

    @property
    def fitted_to(self) -> frozenset[str]:
        """The names of the scans that its provenance ends with."""
        return frozenset(self.provenance.rpartition(": ")[2].split(", "))

    def probability(
        self,
        layers: Float32Array,
        hints: Float32Array,
        mean_odds: Float32Array,
        v: IntArray,
        u: IntArray,
    ) -> Float32Array:
        """Return the probabilities (N,) of pixels (v, u), of `layers_of` and `hints_of`."""
        odds = around.wood_log_odds(
            layers,
            hints,
            mean_odds,
            v,
            u,
            self.first,
            self.first_bias,
            self.second,
            self.second_bias,
        )
        return np.asarray(1.0 / (1.0 + np.exp(-odds)), dtype=np.float32)


def lab_of(view: View) -> UInt8Array:
    """Return the picture (H, W, 3) as lightness and two colours."""
    return np.asarray(cv2.cvtColor(view.color_rgb, cv2.COLOR_RGB2Lab), dtype=np.uint8)


def layers_of(
    view: View, lab: UInt8Array, covered: BoolArray, log_odds: Float32Array
) -> Float32Array:
    """Return what the model looks at (H, W, 4); see `kernels.around`."""
    lightness = lab[..., 0].astype(np.float32) / 255
    clipped = np.clip(log_odds, -_MOST_ODDS, _MOST_ODDS)
    layers = [cv2.GaussianBlur(one, (0, 0), _BLUR_PX) for one in (clipped, lightness)]
    depth_m = depth_of(view).copy()
    cv2.patchNaNs(depth_m, 0.0)
    depth_m[np.isinf(depth_m)] = 0.0
    return np.asarray(cv2.merge([*layers, depth_m, covered.astype(np.float32)]), dtype=np.float32)


def hints_of(maps: Float32Array) -> Float32Array:
    """Return what the model takes from a network's maps (8, h, w): (h, w, HINTS).

    The logits of branch and middle line, the logarithm of the radius, and around each cell the
    highest logit of branch and their mean.
    """
    branch, centre = np.clip(maps[:2], -MOST_LOGIT, MOST_LOGIT)
    near = cv2.dilate(branch, np.ones((_NEAR_CELLS, _NEAR_CELLS), np.uint8))
    around_it = cv2.GaussianBlur(branch, (0, 0), _AROUND_CELLS)
    return np.asarray(cv2.merge([branch, centre, maps[4], near, around_it]), dtype=np.float32)


def figures_of(
    layers: Float32Array, hints: Float32Array, mean_odds: Float32Array, v: IntArray, u: IntArray
) -> Float32Array:
    """Return what the model is told of pixels (v, u): (N, FIGURES)."""
    return around.figures_around(layers, hints, mean_odds, v, u)


def pixel_model_from(value: Mapping[str, Any]) -> PixelModel:
    """Return the model that `pixel_model_to` wrote."""
    first, first_bias, second = (
        np.array(value[name], dtype=np.float32) for name in ("first", "first_bias", "second")
    )
    return PixelModel(
        first=first,
        first_bias=first_bias,
        second=second,
        second_bias=float(value["second_bias"]),
        provenance=value["provenance"],
    )


def pixel_model_to(model: PixelModel) -> bytes:
    """Return the model as JSON, six digits of each weight."""

    def rounded(values: Float32Array) -> list[float]:
        return [float(f"{value:.6g}") for value in values.tolist()]

    rows = ",\n  ".join(json.dumps(rounded(row)) for row in model.first)
    lines = [
        f'"provenance": {json.dumps(model.provenance)}',
        f'"first": [\n  {rows}]',
        f'"first_bias": {json.dumps(rounded(model.first_bias))}',
        f'"second": {json.dumps(rounded(model.second))}',
        f'"second_bias": {model.second_bias:.6g}',
    ]
    return ("{" + ",\n ".join(lines) + "}\n").encode()


@cache
def shipped_pixel_model() -> PixelModel:
    """Return the model this package ships."""
    text = (files("canopy_skel") / "models" / PIXEL_MODEL_FILE).read_text()
    return pixel_model_from(json.loads(text))
