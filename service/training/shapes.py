"""What a user drew around a branch, as pixels: cut where it bends, as the segmenter's own are.

Coordinates are those of the annotation tools: the corners of pixels are whole numbers.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from canopy_skel.geometry import BoolArray, FloatArray
from canopy_skel.segmenters.labels import line_of_mask
from canopy_skel.segmenters.unet.grouping import Grouping
from service.training.run_lengths import decoded

LEAST_PIXELS = 20
"""Smaller parts of a shape are ignored: nobody can say in which direction they run."""
_FINE = 4
# Half of a pixel, and what drawing adds: it includes every fine pixel that an outline touches.
_INSIDE = 0.5 + 0.5 / _FINE
_LONGEST_EDGE = 4.0
_SLENDER = 2.0
_SHORTEST_PX = 12.0
_MOST_BINS = 16


@dataclass(frozen=True, kw_only=True, eq=False, slots=True)
class Region:
    """A mask (h, w) whose upper left pixel is (left, top) in the picture."""

    left: int
    top: int
    mask: BoolArray

    @property
    def box(self) -> tuple[slice, slice]:
        """The region's place in the picture."""
        height, width = self.mask.shape
        return slice(self.top, self.top + height), slice(self.left, self.left + width)


@dataclass(frozen=True, kw_only=True, eq=False, slots=True)
class Shape:
    """One annotation: polygons, a line with a width, or run lengths of the whole picture.

    name: what to call it in messages. outlines: (N, 2) corners x, y each. width_px: of a line
    strip; None = the outlines are filled. runs: COCO run lengths, plain or compressed.
    """

    name: str
    outlines: tuple[FloatArray, ...] = ()
    width_px: float | None = None
    runs: tuple[int, ...] | str | None = None

    def region(self, size: tuple[int, int]) -> Region:
        """Return the pixels more than half of which is inside, in a picture (height, width).

        Raises:
            ValueError: coordinates or run lengths do not fit the picture.
        """
        if self.runs is not None:
            return _cropped(Region(left=0, top=0, mask=decoded(self.runs, *size)))
        if (self.width_px or 0.0) > max(size):
            raise ValueError(f"has a width of {self.width_px:g} pixels, more than the picture")
        points = np.concatenate(self.outlines)
        if not np.isfinite(points).all() or np.abs(points).max() > _LONGEST_EDGE * max(size):
            raise ValueError("has coordinates far outside the picture")
        margin = (self.width_px or 0.0) / 2 + 1
        low = np.clip(np.floor(points.min(axis=0) - margin), 0, size[::-1]).astype(int)
        high = np.clip(np.ceil(points.max(axis=0) + margin), 0, size[::-1]).astype(int)
        (left, top), (width, height) = low.tolist(), (high - low).tolist()
        if width == 0 or height == 0:
            raise ValueError("lies outside the picture")
        fine = np.zeros((height * _FINE, width * _FINE), dtype=np.uint8)
        outlines = [np.rint((one - low) * _FINE - 0.5).astype(np.int32) for one in self.outlines]
        if self.width_px is None:
            cv2.fillPoly(fine, outlines, (1,))
        else:
            cv2.polylines(fine, outlines, False, (1,), max(round(self.width_px * _FINE), 1))
        share = fine.reshape(height, _FINE, width, _FINE).mean(axis=(1, 3))
        return _cropped(Region(left=left, top=top, mask=share >= _INSIDE))


def _cropped(region: Region) -> Region:
    rows, columns = np.flatnonzero(region.mask.any(axis=1)), np.flatnonzero(region.mask.any(axis=0))
    if len(rows) == 0:
        return Region(left=region.left, top=region.top, mask=region.mask[:0, :0])
    mask = region.mask[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
    return Region(left=region.left + int(columns[0]), top=region.top + int(rows[0]), mask=mask)


def connected(region: Region) -> list[Region]:
    """Return the connected parts (8 neighbours) of a region."""
    if not region.mask.any():
        return []  # OpenCV crashes on a picture without pixels
    count, label = cv2.connectedComponents(region.mask.astype(np.uint8))
    parts = [Region(left=region.left, top=region.top, mask=label == k) for k in range(1, count)]
    return [_cropped(part) for part in parts]


def straight(part: Region) -> list[Region]:
    """Cut a connected region where it bends, by the measures of the segmenter's own grouping."""
    at = _bend(part)
    if at is None:
        return [part]
    along, _ = _axes(part)
    sides = (along < at, along >= at)
    halves = [np.zeros(part.mask.shape, dtype=np.bool_) for _ in sides]
    rows, columns = np.nonzero(part.mask)
    for half, side in zip(halves, sides, strict=True):
        half[rows[side], columns[side]] = True
    cut = [Region(left=part.left, top=part.top, mask=half) for half in halves]
    pieces = [piece for half in cut for piece in connected(half)]
    large = [piece for piece in pieces if piece.mask.sum() >= LEAST_PIXELS]
    return [piece for one in large for piece in straight(one)]


def _axes(part: Region) -> tuple[FloatArray, FloatArray]:
    """Return where the pixels of a region are along and across its principal axis, (N,) each."""
    rows, columns = np.nonzero(part.mask)
    points = np.stack([columns, rows], axis=1).astype(np.float64)
    points -= points.mean(axis=0)
    axes = np.linalg.eigh(points.T @ points)[1]
    return points @ axes[:, 1], points @ axes[:, 0]


def _bend(part: Region) -> float | None:
    """Return where along its axis a region is farthest from its chord, None if near enough."""
    along, across = _axes(part)
    low, length = float(along.min()), float(np.ptp(along)) + 1.0
    width = len(along) / length
    if length < max(_SHORTEST_PX, _SLENDER * width):
        return None
    count = int(np.clip(length / 4, 3, _MOST_BINS))
    place = np.minimum(((along - low) / length * count).astype(np.int64), count - 1)
    pixels = np.maximum(np.bincount(place, minlength=count), 1)
    offset = np.bincount(place, across, count) / pixels
    away = np.abs(offset - np.linspace(offset[0], offset[-1], count))
    worst = int(away.argmax())
    rule = Grouping()
    allowed = max(rule.bend_px, rule.bend_share * length, rule.bend_radii * width / 2)
    return low + (worst + 0.5) / count * length if away[worst] > allowed else None


def extent(part: Region) -> tuple[float, float]:
    """Return length and mean width of a region in pixels."""
    line = line_of_mask(part.mask)
    length = max(float(np.linalg.norm(line[-1, :2] - line[0, :2])), 1.0)
    return length, float(part.mask.sum()) / length


def is_slender(part: Region) -> bool:
    """Say whether a region is clearly longer than wide, as a piece of a branch is."""
    length, width = extent(part)
    return length >= _SLENDER * width


def middle_lines(pieces: Sequence[Region]) -> tuple[FloatArray, ...]:
    """Return the middle line (N, 3) u, v, radius of each piece, in the picture."""
    return tuple(
        line_of_mask(piece.mask) + np.array([piece.left, piece.top, 0.0]) for piece in pieces
    )
