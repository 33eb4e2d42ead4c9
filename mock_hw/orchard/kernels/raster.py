"""The z-buffer. Pixel centres are at integer coordinates; `w` grows towards the viewer."""

import numpy as np
from numba import njit
from numpy.typing import NDArray

F64 = NDArray[np.float64]
I32 = NDArray[np.int32]
U8 = NDArray[np.uint8]


@njit(cache=True)
def draw(screen: F64, triangles: I32, w_buffer: F64, id_buffer: I32) -> None:
    """Draw all triangles; the nearest wins, at equal depth the first.

    Args:
        screen: (P, 3) u, v in pixels and w, linear on screen (1/z, or minus the distance of a
            parallel projection); a triangle with a w of 0 (behind the camera) is left out.
        triangles: (T, 3).
        w_buffer: (H, W), starts at the w of the far end.
        id_buffer: (H, W), gets the triangle's number.
    """
    height, width = id_buffer.shape
    for t in range(len(triangles)):
        ia, ib, ic = triangles[t, 0], triangles[t, 1], triangles[t, 2]
        ua, va, wa = screen[ia, 0], screen[ia, 1], screen[ia, 2]
        ub, vb, wb = screen[ib, 0], screen[ib, 1], screen[ib, 2]
        uc, vc, wc = screen[ic, 0], screen[ic, 1], screen[ic, 2]
        if wa == 0.0 or wb == 0.0 or wc == 0.0:
            continue
        v0 = max(int(np.ceil(min(va, vb, vc))), 0)
        v1 = min(int(np.floor(max(va, vb, vc))), height - 1)
        u0 = max(int(np.ceil(min(ua, ub, uc))), 0)
        u1 = min(int(np.floor(max(ua, ub, uc))), width - 1)
        area = (ub - ua) * (vc - va) - (uc - ua) * (vb - va)
        if v0 > v1 or u0 > u1 or area == 0.0:
            continue
        inverse = 1.0 / area
        for v in range(v0, v1 + 1):
            for u in range(u0, u1 + 1):
                b = ((u - ua) * (vc - va) - (uc - ua) * (v - va)) * inverse
                c = ((ub - ua) * (v - va) - (u - ua) * (vb - va)) * inverse
                a = 1.0 - b - c
                if a < 0.0 or b < 0.0 or c < 0.0:
                    continue
                w = a * wa + b * wb + c * wc
                if w > w_buffer[v, u]:
                    w_buffer[v, u] = w
                    id_buffer[v, u] = t


@njit(cache=True)
def first_cover(screen: F64, triangles: I32, per_leaf: int, w_buffer: F64, cover: I32) -> None:
    """Write to each pixel the first leaf in front of what `w_buffer` (H, W) holds.

    `cover` (H, W) starts at a number larger than any leaf's; pixels of no interest start at -1.
    Arguments as for `draw`; leaf k owns the triangles [k * per_leaf, (k + 1) * per_leaf).
    """
    height, width = cover.shape
    for t in range(len(triangles)):
        ia, ib, ic = triangles[t, 0], triangles[t, 1], triangles[t, 2]
        ua, va, wa = screen[ia, 0], screen[ia, 1], screen[ia, 2]
        ub, vb, wb = screen[ib, 0], screen[ib, 1], screen[ib, 2]
        uc, vc, wc = screen[ic, 0], screen[ic, 1], screen[ic, 2]
        if wa == 0.0 or wb == 0.0 or wc == 0.0:
            continue
        leaf = t // per_leaf
        v0 = max(int(np.ceil(min(va, vb, vc))), 0)
        v1 = min(int(np.floor(max(va, vb, vc))), height - 1)
        u0 = max(int(np.ceil(min(ua, ub, uc))), 0)
        u1 = min(int(np.floor(max(ua, ub, uc))), width - 1)
        area = (ub - ua) * (vc - va) - (uc - ua) * (vb - va)
        if v0 > v1 or u0 > u1 or area == 0.0:
            continue
        inverse = 1.0 / area
        for v in range(v0, v1 + 1):
            for u in range(u0, u1 + 1):
                if cover[v, u] <= leaf:
                    continue
                b = ((u - ua) * (vc - va) - (uc - ua) * (v - va)) * inverse
                c = ((ub - ua) * (v - va) - (u - ua) * (vb - va)) * inverse
                a = 1.0 - b - c
                if a < 0.0 or b < 0.0 or c < 0.0:
                    continue
                if a * wa + b * wb + c * wc > w_buffer[v, u]:
                    cover[v, u] = leaf
