"""Where the outline of a region of wood is its own, and not that of a leaf in front of it."""

from math import atan2, ceil, cos, floor, sin

import numpy as np
from numpy.typing import NDArray

from canopy_skel.kernels.compiled import inner, kernel

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Picture = NDArray[np.float32]

RIM = 6
"""Figures of a rim: place (u, v), the way across the region from there (u, v), its depth, which."""
_EVERY_PX = 3
_HALF = 0.5 + 1e-6
"""Of rows that are parted between two, all pixels go to one."""
_FIRST_PX, _BLEEDS_PX, _NOTHING_PX, _LAST_PX = 2, 4, 6, 8


@inner("void(float64[::1], float64[::1], int64, int64, float64[::1])")
def _axis(u: Floats, v: Floats, begin: int, end: int, out: Floats) -> None:
    """Write middle (u, v) and direction (u, v) of pixels, and how far they reach along it."""
    mu, mv, uu, uv, vv = 0.0, 0.0, 0.0, 0.0, 0.0
    for k in range(begin, end):
        mu += u[k]
        mv += v[k]
    mu, mv = mu / (end - begin), mv / (end - begin)
    for k in range(begin, end):
        du, dv = u[k] - mu, v[k] - mv
        uu += du * du
        uv += du * dv
        vv += dv * dv
    angle = 0.5 * atan2(2 * uv, uu - vv)
    c, s = cos(angle), sin(angle)
    reach = 0.0
    for k in range(begin, end):
        reach = max(reach, abs((u[k] - mu) * c + (v[k] - mv) * s))
    out[0], out[1], out[2], out[3], out[4] = mu, mv, c, s, reach


@inner(
    "boolean(Array(float32, 2, 'C', readonly=True), float64, float64, float64, float64, float64)"
)
def _ends_here(depth_m: Picture, u: float, v: float, qu: float, qv: float, behind_m: float) -> bool:
    """Say whether what lies beyond a place on an outline, along (qu, qv), is farther away.

    Depth bleeds over edges: what is as near counts from `_BLEEDS_PX` on. Without return for
    `_NOTHING_PX` it is sky. What leaves the picture is unknown.
    """
    for step in range(_FIRST_PX, _LAST_PX + 1):
        x, y = floor(u + step * qu + 0.5), floor(v + step * qv + 0.5)
        if not (0 <= y < depth_m.shape[0] and 0 <= x < depth_m.shape[1]):
            return False
        z = depth_m[y, x]
        if z > 0.0:
            if z >= behind_m:
                return True
            if step >= _BLEEDS_PX:
                return False
        elif step >= _NOTHING_PX:
            return True
    return False


@kernel(
    "float64[:,::1](float64[::1], float64[::1], int64[::1], Array(float32, 2, 'C', readonly=True),"
    " float64[::1], float64)"
)
def rims(
    u: Floats, v: Floats, start: Ints, depth_m: Picture, middle_m: Floats, step_m: float
) -> Floats:
    """Return the rims (M, RIM) of regions: where they end before something farther away.

    u, v: pixels; region i has those from start[i] up to start[i + 1]. depth_m: (H, W), NaN without
    return. middle_m: depth of each region; what lies `step_m` behind that is farther away. Every
    third row of pixels across a region is looked at, on both sides.
    """
    count = len(start) - 1
    axes = np.empty((count, 5))
    room = 0
    for i in range(count):
        _axis(u, v, start[i], start[i + 1], axes[i])
        room += 2 * (2 * ceil(axes[i, 4]) // _EVERY_PX + 3)
    out, found = np.empty((room, RIM)), 0
    for i in range(count):
        mu, mv, c, s = axes[i, 0], axes[i, 1], axes[i, 2], axes[i, 3]
        rows = 2 * ceil(axes[i, 4]) // _EVERY_PX + 2
        outer, at = np.full((rows, 2), -np.inf), np.full((rows, 2), -1, dtype=np.int64)
        for k in range(start[i], start[i + 1]):
            du, dv = u[k] - mu, v[k] - mv
            along = floor(du * c + dv * s + _HALF) + ceil(axes[i, 4])
            if along % _EVERY_PX:
                continue
            row, across = along // _EVERY_PX, dv * c - du * s
            for side in range(2):
                away = across if side == 0 else -across
                if away > outer[row, side]:
                    outer[row, side], at[row, side] = away, k
        for row in range(rows):
            for side in range(2):
                k = at[row, side]
                if k < 0:
                    continue
                sign = 1.0 if side == 0 else -1.0
                qu, qv = -sign * s, sign * c
                if _ends_here(depth_m, u[k], v[k], qu, qv, middle_m[i] + step_m):
                    out[found, 0], out[found, 1] = u[k] + 0.5 * qu, v[k] + 0.5 * qv
                    out[found, 2], out[found, 3] = -qu, -qv
                    out[found, 4], out[found, 5] = middle_m[i], i
                    found += 1
    return out[:found].copy()
