"""The z-buffer. Pixel centres are at integer coordinates; `w` grows towards the viewer."""

import numpy as np
from numba import njit
from numpy.typing import NDArray

F64 = NDArray[np.float64]
I32 = NDArray[np.int32]
Corners = tuple[float, float, float, float, float, float, float, float, float]


@njit(cache=True)
def _corners(screen: F64, triangle: I32) -> Corners:
    a, b, c = screen[triangle[0]], screen[triangle[1]], screen[triangle[2]]
    return a[0], a[1], a[2], b[0], b[1], b[2], c[0], c[1], c[2]


@njit(cache=True)
def _box(corners: Corners, height: int, width: int) -> tuple[int, int, int, int, float]:
    """Return the pixel rows and columns of a triangle (ends open) and its doubled area."""
    ua, va, wa, ub, vb, wb, uc, vc, wc = corners
    if wa == 0.0 or wb == 0.0 or wc == 0.0:
        return 0, 0, 0, 0, 1.0
    v0 = max(int(np.ceil(min(va, vb, vc))), 0)
    v1 = min(int(np.floor(max(va, vb, vc))) + 1, height)
    u0 = max(int(np.ceil(min(ua, ub, uc))), 0)
    u1 = min(int(np.floor(max(ua, ub, uc))) + 1, width)
    area = (ub - ua) * (vc - va) - (uc - ua) * (vb - va)
    if area == 0.0:
        return 0, 0, 0, 0, 1.0
    return v0, v1, u0, u1, area


@njit(cache=True)
def _w_at(corners: Corners, inverse_area: float, u: int, v: int) -> float:
    """Return w at a pixel, 0 outside the triangle."""
    ua, va, wa, ub, vb, wb, uc, vc, wc = corners
    b = ((u - ua) * (vc - va) - (uc - ua) * (v - va)) * inverse_area
    c = ((ub - ua) * (v - va) - (u - ua) * (vb - va)) * inverse_area
    a = 1.0 - b - c
    if a < 0.0 or b < 0.0 or c < 0.0:
        return 0.0
    return a * wa + b * wb + c * wc


@njit(cache=True, nogil=True)
def draw(screen: F64, triangles: I32, w_buffer: F64, id_buffer: I32) -> None:
    """Draw all triangles; the nearest wins, at equal depth the first.

    Args:
        screen: (P, 3) u, v in pixels and w > 0, linear on screen (1/z, or a constant minus the
            distance in a parallel projection); w = 0 marks points to be left out.
        triangles: (T, 3).
        w_buffer: (H, W), starts at the w of the far end.
        id_buffer: (H, W), gets the triangle's number.
    """
    height, width = id_buffer.shape
    for t in range(len(triangles)):
        corners = _corners(screen, triangles[t])
        v0, v1, u0, u1, area = _box(corners, height, width)
        for v in range(v0, v1):
            for u in range(u0, u1):
                w = _w_at(corners, 1.0 / area, u, v)
                if w > w_buffer[v, u]:
                    w_buffer[v, u] = w
                    id_buffer[v, u] = t


@njit(cache=True, nogil=True)
def first_cover(screen: F64, triangles: I32, per_leaf: int, w_buffer: F64, cover: I32) -> None:
    """Write to each pixel the first leaf in front of what `w_buffer` (H, W) holds.

    `cover` (H, W) starts at a number larger than any leaf's; pixels of no interest start at -1.
    Arguments as for `draw`; leaf k owns the triangles [k * per_leaf, (k + 1) * per_leaf).
    """
    height, width = cover.shape
    for t in range(len(triangles)):
        leaf = t // per_leaf
        corners = _corners(screen, triangles[t])
        v0, v1, u0, u1, area = _box(corners, height, width)
        for v in range(v0, v1):
            for u in range(u0, u1):
                if cover[v, u] > leaf and _w_at(corners, 1.0 / area, u, v) > w_buffer[v, u]:
                    cover[v, u] = leaf
