"""Connected components of pictures: thousands of small ones, or few in a large picture."""

from dataclasses import dataclass

import cv2
import numpy as np

from canopy_skel.geometry import BoolArray, IntArray
from canopy_skel.kernels import components as kernel


@dataclass(frozen=True, kw_only=True, eq=False, slots=True)
class Runs:
    """The pixels of a mask (H, W), row by row, and how they are connected.

    row, first_px, length: (R,), pixels first_px up to first_px + length of a row, in raster order.
    component: (R,), the first run that it is connected with, corners included. area: (R,), the
    pixels of that component.
    """

    row: IntArray
    first_px: IntArray
    length: IntArray
    component: IntArray
    area: IntArray


def runs_of(mask: BoolArray) -> Runs:
    """Return the runs of a mask (H, W)."""
    padded = cv2.copyMakeBorder(mask.view(np.uint8), 0, 0, 1, 1, cv2.BORDER_CONSTANT, value=0)
    width, flat = padded.shape[1], padded.ravel()
    changes = np.flatnonzero(flat[1:] != flat[:-1]) + 1
    starts, ends = changes[::2].copy(), changes[1::2].copy()
    component, length = kernel.connected_runs(starts, ends, width), ends - starts
    area = np.bincount(component, weights=length, minlength=len(starts)).astype(np.int64)
    row = starts // width
    return Runs(
        row=row,
        first_px=starts - row * width - 1,
        length=length,
        component=component,
        area=area[component],
    )


def painted(runs: Runs, chosen: BoolArray, shape: tuple[int, int]) -> BoolArray:
    """Return the mask (H, W) of the chosen runs (R,)."""
    start = runs.row[chosen] * shape[1] + runs.first_px[chosen]
    bounds = np.column_stack([start, start + runs.length[chosen]]).ravel()
    between = np.diff(bounds, prepend=0, append=shape[0] * shape[1])
    inside = np.arange(len(between)) % 2 == 1
    return np.repeat(inside, between).reshape(shape)


def pixels_of(runs: Runs, chosen: IntArray) -> tuple[IntArray, IntArray]:
    """Return rows and columns of the pixels of chosen runs (C,), run by run."""
    length = runs.length[chosen]
    before = np.cumsum(length) - length
    u = np.repeat(runs.first_px[chosen] - before, length) + np.arange(length.sum())
    return np.repeat(runs.row[chosen], length), u
