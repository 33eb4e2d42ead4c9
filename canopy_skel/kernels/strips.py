"""Strips along strands: what a network says of a picture, laid out along the axis of each strand.

Places are in cells of the network's grid, u to the right and v down.
"""

from math import atan2, cos, floor, log, sin

import numpy as np
from numpy.typing import NDArray

from canopy_skel.kernels.compiled import inner, kernel

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
I64 = NDArray[np.int64]
Bool = NDArray[np.bool_]

MAPS = 8
"""Branch, middle line, cos 2θ, sin 2θ, log radius, way to the middle (u, v), log length."""
AXIS = 7
"""Figures of an axis: middle (u, v), cos θ, sin θ, half the length, log radius, log length."""


@kernel("void(int64[::1], int64[::1], float32[:,:,::1], int64, float64[:,::1])")
def axes(cells: I64, ends: I64, maps: F32, stride: int, out: F64) -> None:
    """Fill out (N, AXIS) with the axes of strands: strand i has the cells from ends[i] on.

    maps: (MAPS, h, w). stride: the picture's pixels for one cell, which lengths there count.
    """
    width = maps.shape[2]
    for i in range(len(out)):
        begin, end = ends[i], ends[i + 1]
        count = end - begin
        u, v, log_radius = 0.0, 0.0, 0.0
        for cell in cells[begin:end]:
            u += cell % width
            v += cell // width
            log_radius += float(maps[4, cell // width, cell % width])
        u, v, log_radius = u / count, v / count, log_radius / count
        uu, uv, vv = 0.0, 0.0, 0.0
        for cell in cells[begin:end]:
            du, dv = cell % width - u, cell // width - v
            uu += du * du
            uv += du * dv
            vv += dv * dv
        angle = 0.5 * atan2(2 * uv, uu - vv)
        c, s = cos(angle), sin(angle)
        low, high = np.inf, -np.inf
        for cell in cells[begin:end]:
            along = (cell % width - u) * c + (cell // width - v) * s
            low, high = min(low, along), max(high, along)
        middle, length = 0.5 * (low + high), high - low + 1
        out[i, 0], out[i, 1] = u + middle * c, v + middle * s
        out[i, 2], out[i, 3] = c, s
        out[i, 4], out[i, 5], out[i, 6] = 0.5 * length, log_radius, log(stride * length)


@inner("void(float32[:,:,::1], float32[:,:,:], float64, float64, float32[::1])")
def _read_between(maps: F32, features: F32, u: float, v: float, sample: F32) -> None:
    """Add maps and features at a place between cells to a sample, all 0; nothing outside."""
    height, width = maps.shape[1:]
    column, row = floor(u), floor(v)
    for y in range(row, row + 2):
        for x in range(column, column + 2):
            if 0 <= y < height and 0 <= x < width:
                share = np.float32((1 - abs(u - x)) * (1 - abs(v - y)))
                for k in range(MAPS):
                    sample[k] += share * maps[k, y, x]
                for k in range(len(features)):
                    sample[MAPS + k] += share * features[k, y, x]


@inner("void(float64[::1], float64, float32[::1])")
def _seen_from(axis: F64, most_logit: float, sample: F32) -> None:
    """Turn directions and ways of a sample to an axis; radius and length are those beside its own.

    Logits are at most `most_logit`.
    """
    c, s = axis[2], axis[3]
    twice_c, twice_s = c * c - s * s, 2 * c * s
    cosine, sine, ahead, beside = sample[2], sample[3], sample[5], sample[6]
    sample[2], sample[3] = cosine * twice_c + sine * twice_s, sine * twice_c - cosine * twice_s
    sample[5], sample[6] = ahead * c + beside * s, beside * c - ahead * s
    sample[4] -= axis[5]
    sample[7] -= axis[6]
    for k in range(2):
        sample[k] = min(max(sample[k], -most_logit), most_logit)


@kernel(
    "void(float32[:,:,::1], float32[:,:,:], float64[:,::1], float64[::1], int64[::1], int64[::1],"
    " float64, float64, boolean[::1], float32[:,:,:,::1])"
)
def looked_along(
    maps: F32,
    features: F32,
    axis: F64,
    side: F64,
    cells: I64,
    ends: I64,
    beyond: float,
    most_logit: float,
    own: Bool,
    out: F32,
) -> None:
    """Fill out (N, ALONG, ACROSS, MAPS + K + 2), all 0, with strips of maps and features.

    maps: (MAPS, h, w). features: (K, h, w). A strip is as long as `beyond` times the strand and
    `side` (N,) wide to either side. Of each place: the maps and the features there, as
    `_seen_from` the axis; whether it is of the strand; whether it is in the picture.
    own: (h w,), all False.
    """
    height, width = maps.shape[1:]
    known = MAPS + len(features)
    far, aside = out.shape[1], out.shape[2]
    for i in range(len(out)):
        c, s = axis[i, 2], axis[i, 3]
        for cell in cells[ends[i] : ends[i + 1]]:
            own[cell] = True
        for a in range(far):
            along = (2 * a / (far - 1) - 1) * beyond * axis[i, 4]
            for b in range(aside):
                across = (2 * b / (aside - 1) - 1) * side[i]
                u = axis[i, 0] + along * c - across * s
                v = axis[i, 1] + along * s + across * c
                _read_between(maps, features, u, v, out[i, a, b])
                _seen_from(axis[i], most_logit, out[i, a, b])
                x, y = round(u), round(v)
                if 0 <= y < height and 0 <= x < width:
                    out[i, a, b, known] = own[y * width + x]
                    out[i, a, b, known + 1] = 1
        for cell in cells[ends[i] : ends[i + 1]]:
            own[cell] = False
