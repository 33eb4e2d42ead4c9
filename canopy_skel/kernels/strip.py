"""How wide a slender mask is, where leaves have bitten pieces out of its edges."""

import math

import numpy as np
from numpy.typing import NDArray

from canopy_skel.kernels.compiled import inner, kernel

Floats = NDArray[np.float64]

SECTION_PX = 6.0
"""Length of a cross-section along the mask: about the width of a twig, or pixels would show."""
WIDE_SHARE = 2.0 / 3.0
"""Of the mask's area, how much lies in cross-sections that are narrower than its width."""


@inner("float64(float64[::1], int64, int64)")
def sort(values: Floats, first: int, end: int) -> float:
    """Sort values [first, end), of which there are few, in place; return their sum."""
    total = 0.0
    for i in range(first, end):
        value, at = values[i], i
        total += value
        while at > first and values[at - 1] > value:
            values[at] = values[at - 1]
            at -= 1
        values[at] = value
    return total


@kernel("void(boolean[:,:], float64[::1])")
def measure(mask: NDArray[np.bool_], strip: Floats) -> None:
    """Write half the width of a mask in pixels, its mean pixel (u, v), its unit direction (u, v).

    The width is the quantile `WIDE_SHARE` of those of cross-sections, by area. Leaves can only make
    a section narrower, and a narrow one has less area.
    """
    count = 0
    su = sv = suu = suv = svv = 0.0
    for v in range(mask.shape[0]):
        for u in range(mask.shape[1]):
            if mask[v, u]:
                count += 1
                su, sv = su + u, sv + v
                suu, suv, svv = suu + u * u, suv + u * v, svv + v * v
    mu, mv = su / count, sv / count
    angle = 0.5 * math.atan2(
        2.0 * (suv / count - mu * mv), suu / count - mu * mu - svv / count + mv * mv
    )
    du, dv = math.cos(angle), math.sin(angle)
    low, high = math.inf, -math.inf
    for v in range(mask.shape[0]):
        for u in range(mask.shape[1]):
            if mask[v, u]:
                t = (u - mu) * du + (v - mv) * dv
                low, high = min(low, t), max(high, t)
    low, high = low - 0.5, high + 0.5
    sections = max(1, int((high - low) / SECTION_PX))
    area = np.zeros(sections)
    per_px = sections / (high - low)
    for v in range(mask.shape[0]):
        for u in range(mask.shape[1]):
            if mask[v, u]:
                t = (u - mu) * du + (v - mv) * dv
                area[min(int((t - low) * per_px), sections - 1)] += 1.0
    first, end = 0, sections
    if sections > 4 and count > area[0] + area[sections - 1]:
        first, end = 1, sections - 1  # Those at the ends are cut off slantwise.
    wanted = WIDE_SHARE * sort(area, first, end)
    so_far, widest = 0.0, first
    while so_far + area[widest] < wanted:
        so_far += area[widest]
        widest += 1
    strip[0] = 0.5 * area[widest] * per_px
    strip[1], strip[2], strip[3], strip[4] = mu, mv, du, dv
