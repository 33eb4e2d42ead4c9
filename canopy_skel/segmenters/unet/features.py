"""What tells a branch from what only looks like one: measures of each strand, for its score."""

from dataclasses import dataclass

import numpy as np
from scipy.special import expit

from canopy_skel.frame import Float32Array
from canopy_skel.geometry import BoolArray, FloatArray, IntArray
from canopy_skel.kernels.strands import I32
from canopy_skel.segmenters.unet.targets import STRIDE

FEATURES = (
    "branch",
    "sure",
    "centre",
    "line_branch",
    "line_centre",
    "direction",
    "axis",
    "crook",
    "fill",
    "stout",
    "radius_spread",
    "log_length",
    "log_radius",
)
_SURE = 0.8


@dataclass(frozen=True, kw_only=True, eq=False, slots=True)
class Measures:
    """Of N strands: size in pixels, length and features (N, len(FEATURES)).

    Features: mean probability of branch, and share of cells above 0.8; of the middle line; both
    along the middle line; agreement of direction, and of direction with the strand's axis; how far
    the middle line strays from its axis, in radii; area over that of a strip of this length and
    radius; width over length; spread of the logarithm of the radius; logarithms of length and
    radius in pixels.
    """

    pixels: FloatArray
    length_px: FloatArray
    features: FloatArray


@dataclass(frozen=True, kw_only=True, eq=False, slots=True)
class _Shape:
    """Moments of N groups of cells: along and across their axes, and the axes' angles."""

    along: FloatArray
    across: FloatArray
    angle: FloatArray


def measured(
    label: I32, middle: I32, count: int, maps: Float32Array, log_radius: Float32Array
) -> Measures:
    """Measure strands 1 … count of a (h, w) label image.

    middle: (h, w) the same numbers on their middle lines alone. maps: (5, h, w) of the network.
    log_radius: (h, w), smoothed, in cells.
    """
    rows, columns = np.nonzero(label)
    own = label[rows, columns].astype(np.int64) - 1
    line_rows, line_columns = np.nonzero(middle)
    line_own = middle[line_rows, line_columns].astype(np.int64) - 1

    def mean(values: FloatArray | Float32Array | BoolArray) -> FloatArray:
        return _mean(values, own, count)

    def along(values: FloatArray | Float32Array) -> FloatArray:
        return _mean(values[line_rows, line_columns], line_own, count)

    branch, centre = expit(maps[0, rows, columns]), maps[1, rows, columns]
    cosine, sine = mean(maps[2, rows, columns]), mean(maps[3, rows, columns])
    radii = log_radius[rows, columns]
    log_mean = mean(radii)
    body = _shape(rows, columns, own, count)
    line = _shape(line_rows, line_columns, line_own, count)
    length = np.sqrt(12 * body.along + 1)
    cells = np.bincount(own, minlength=count)
    radius = np.exp(log_mean)
    features = [
        mean(branch),
        mean(branch > _SURE),
        mean(expit(centre)),
        along(expit(maps[0])),
        along(expit(maps[1])),
        np.hypot(cosine, sine),
        np.cos(2 * line.angle) * cosine + np.sin(2 * line.angle) * sine,
        np.minimum(np.sqrt(line.across) / np.maximum(radius, 1.0), 3.0),
        np.minimum(cells / (2 * radius * length), 2.0),
        np.sqrt(12 * body.across + 1) / length,
        np.sqrt(np.maximum(mean(radii**2) - log_mean**2, 0.0)),
        np.log(STRIDE * length),
        log_mean + np.log(STRIDE),
    ]
    return Measures(
        pixels=(STRIDE**2 * cells).astype(np.float64),
        length_px=STRIDE * length,
        features=np.column_stack(features),
    )


def _mean(values: FloatArray | Float32Array | BoolArray, own: IntArray, count: int) -> FloatArray:
    cells = np.maximum(np.bincount(own, minlength=count), 1)
    return np.bincount(own, values, count) / cells


def _shape(rows: IntArray, columns: IntArray, own: IntArray, count: int) -> _Shape:
    u, v = columns.astype(np.float64), rows.astype(np.float64)
    du, dv = u - _mean(u, own, count)[own], v - _mean(v, own, count)[own]
    uu, vv, uv = (_mean(x, own, count) for x in (du * du, dv * dv, du * dv))
    middle, reach = 0.5 * (uu + vv), np.sqrt(0.25 * (uu - vv) ** 2 + uv**2)
    return _Shape(
        along=middle + reach,
        across=np.maximum(middle - reach, 0.0),
        angle=0.5 * np.arctan2(2 * uv, uu - vv),
    )
