"""Masks as COCO writes them: polygons along pixel edges, run lengths, boxes.

COCO's coordinates are continuous: pixel (0, 0) covers 0…1 in both directions. Outlines through
pixel centres, which OpenCV gives, would take a pixel off the width of every branch.
"""

import cv2
import numpy as np

from canopy_skel.geometry import BoolArray, IntArray

_FINE = 3


def polygons(mask: BoolArray) -> list[list[int]]:
    """Return the outline of each 8-connected part of a (H, W) mask that is not empty.

    Each is a flat list x, y, x, y, …. A hole is joined to its outline by a cut of no width, since
    COCO's polygons know no holes. An even-odd fill of them is the mask, to the pixel.
    """
    left, top, width, height = box(mask)
    part = mask[top : top + height, left : left + width].astype(np.uint8)
    fine = np.kron(part, np.ones((_FINE, _FINE), np.uint8))
    contours, hierarchy = cv2.findContours(fine, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_SIMPLE)
    corner = np.array([left, top])
    rings = [
        _corners(corner + (contour.reshape(-1, 2).astype(np.int64) + 1) // _FINE)
        for contour in contours
    ]
    parents = hierarchy[0][:, 3]
    outlines = {k: rings[k] for k in np.flatnonzero(parents < 0)}
    for hole in np.flatnonzero(parents >= 0):
        outlines[parents[hole]] = _joined(outlines[parents[hole]], rings[hole])
    return [outline.ravel().tolist() for outline in outlines.values()]


def run_lengths(mask: BoolArray) -> list[int]:
    """Return COCO's uncompressed run lengths: column by column, starting with zeros."""
    flat = mask.ravel(order="F")
    turns = np.flatnonzero(np.diff(flat)) + 1
    lengths = np.diff(np.concatenate([[0], turns, [flat.size]])).tolist()
    return [0, *lengths] if flat[0] else lengths


def box(mask: BoolArray) -> list[int]:
    """Return left, top, width and height of what a mask covers."""
    v, u = np.nonzero(mask)
    left, top = int(u.min()), int(v.min())
    return [left, top, int(u.max()) - left + 1, int(v.max()) - top + 1]


def _corners(ring: IntArray) -> IntArray:
    """Return the (N, 2) corners of a closed ring: no point twice, none on a straight line."""
    ring = ring[(ring != np.roll(ring, 1, axis=0)).any(axis=1)]
    before, after = ring - np.roll(ring, 1, axis=0), np.roll(ring, -1, axis=0) - ring
    turns = before[:, 0] * after[:, 1] != before[:, 1] * after[:, 0]
    return np.asarray(ring[turns | ((before * after).sum(axis=1) < 0)])


def _joined(outer: IntArray, hole: IntArray) -> IntArray:
    """Return one ring: along the outline, over to the hole where they are closest, and back."""
    gaps = np.abs(outer[:, None] - hole[None]).sum(axis=2)
    leave, enter = np.unravel_index(int(gaps.argmin()), gaps.shape)
    round_trip = np.roll(hole, -enter, axis=0)
    return np.concatenate([outer[: leave + 1], round_trip, round_trip[:1], outer[leave:]])
