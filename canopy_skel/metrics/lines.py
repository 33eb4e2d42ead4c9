"""Middle lines in a picture: whether two of them are the same branch, and which lie on which."""

from dataclasses import dataclass
from typing import Self

import numpy as np
from scipy.spatial import cKDTree

from canopy_skel.geometry import BoolArray, FloatArray

STEP_PX = 1.0
BESIDE_PX = 3.0
"""A line lies on a branch up to this far outside its wood."""
LARGEST_TURN_DEG = 10.0
LEAST_OVERLAP = 0.5


@dataclass(frozen=True, kw_only=True, eq=False, slots=True)
class MiddleLine:
    """A middle line sampled every pixel.

    points: (N, 2) u, v. radius_px: (N,). length_px: of the whole line. Each sample stands for
    length_px / N.
    """

    points: FloatArray
    radius_px: FloatArray
    length_px: float

    @classmethod
    def of(cls, line: FloatArray) -> Self:
        """Sample a polyline (V, 3) of u, v, radius, V >= 1."""
        step = np.linalg.norm(np.diff(line[:, :2], axis=0), axis=1)
        along = np.concatenate([[0.0], np.cumsum(step)])
        length = float(along[-1])
        count = max(int(np.ceil(length / STEP_PX)), 1)
        stations = (np.arange(count) + 0.5) * (length / count)
        u, v, radius = (np.interp(stations, along, line[:, k]) for k in range(3))
        return cls(points=np.stack([u, v], axis=1), radius_px=radius, length_px=length)

    @property
    def weight(self) -> FloatArray:
        """The length each sample stands for, (N,)."""
        return np.full(len(self.points), self.length_px / len(self.points))


def overlap(one: MiddleLine, other: MiddleLine) -> float:
    """Return how much of the longer of two lines runs along the other, 0 where they differ.

    Lines run along each other where they are nearer than a radius (of `other`) and 3 pixels, and
    neither goes on past the other's end. They differ when the common stretches, chord against
    chord, are 10 degrees apart or more.
    """
    apart = np.linalg.norm(one.points[:, None] - other.points[None], axis=2)
    foot = apart.argmin(axis=1)
    near = apart[np.arange(len(foot)), foot] < other.radius_px[foot] + BESIDE_PX
    near &= _beside(one.points, other.points, foot)
    if near.sum() < 2:
        return 0.0
    first, last = np.flatnonzero(near)[[0, -1]]
    low, high = foot[near].min(), foot[near].max()
    chord = one.points[last] - one.points[first]
    chord_other = other.points[foot[last]] - other.points[foot[first]]
    size = float(np.linalg.norm(chord) * np.linalg.norm(chord_other))
    if size == 0 or abs(chord @ chord_other) <= np.cos(np.radians(LARGEST_TURN_DEG)) * size:
        return 0.0
    return min(float(near.mean()), float((high - low + 1) / len(other.points)))


def _beside(points: FloatArray, others: FloatArray, foot: np.ndarray) -> BoolArray:
    """Say which points (N,) do not lie past the ends of the line their foot is on."""
    if len(others) < 2:
        return np.zeros(len(points), dtype=np.bool_)
    past_first = (points - others[0]) @ (others[0] - others[1]) > STEP_PX
    past_last = (points - others[-1]) @ (others[-1] - others[-2]) > STEP_PX
    return np.asarray(~((foot == 0) & past_first | (foot == len(others) - 1) & past_last))


def overlaps(found: list[MiddleLine], true: list[MiddleLine]) -> FloatArray:
    """Return the (N, M) `overlap` of found lines with true ones; only near ones are looked at."""
    result = np.zeros((len(found), len(true)))
    low_true = np.array([one.points.min(axis=0) for one in true]).reshape(-1, 2)
    high_true = np.array([one.points.max(axis=0) for one in true]).reshape(-1, 2)
    margin = np.array([one.radius_px.max() + BESIDE_PX for one in true]).reshape(-1, 1)
    for row, one in enumerate(found):
        low, high = one.points.min(axis=0), one.points.max(axis=0)
        apart = (low > high_true + margin) | (high < low_true - margin)
        for column in np.flatnonzero(~apart.any(axis=1)).tolist():
            result[row, column] = overlap(one, true[column])
    return result


def covered(lines: list[MiddleLine], by: list[MiddleLine], tolerance_px: float) -> list[BoolArray]:
    """Say of each line's samples whether some sample of `by` is within the tolerance.

    The tolerance is a third of the line's own radius where that is more: the middle of a trunk is
    not found to the pixel.
    """
    if not by:
        return [np.zeros(len(line.points), dtype=np.bool_) for line in lines]
    tree = cKDTree(np.concatenate([line.points for line in by]))
    return [
        np.asarray(
            tree.query(line.points)[0] <= np.maximum(tolerance_px, line.radius_px / 3),
            dtype=np.bool_,
        )
        for line in lines
    ]
