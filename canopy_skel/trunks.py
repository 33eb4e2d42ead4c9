"""Axes of thick wood of which leaves leave only strips, from its bark and outlines in all views."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from canopy_skel.evidence import is_empty
from canopy_skel.fusion import Observations, heaviest
from canopy_skel.geometry import BoolArray, FloatArray, IntArray
from canopy_skel.kernels import trunks
from canopy_skel.outlines import BARK, OUTLINE, THINNEST_M, Outlines

_CELL_M = 0.015
"""One place is tried in each such cell: strips run askew, and some lead where others do not."""
_MIN_COSINE, _ALONG_M, _ACROSS_M, _REACH_M = 0.85, 0.05, 0.11, 0.13
_LEAST_POINTS, _MOST_POINTS, _MOST_LINES = 40, 96, 64
_COUNTS_AS = 20.0
"""However many points there are, of bark and of outlines: neighbours err alike."""
_BARK_M, _OUTLINE_M = 0.006, 0.004
_SPREAD, _EXPECTED, _SECOND_START = 0.5, 1.1, 1.7
_THICK_M, _THICKEST_M, _TIMES_THICKER, _TIMES_PIECES = 0.018, 0.1, 1.2, 1.7
_DEVIATION, _ON_BARK, _ON_OUTLINES, _THROUGH = 0.1, 0.9, 0.4, 0.2
"""Of the radius at most; shares of the bark and of the outlines on it at least; through it."""
_LIMITS = np.array(
    [
        _MIN_COSINE,
        _ALONG_M,
        _ACROSS_M,
        _LEAST_POINTS,
        _BARK_M,
        _OUTLINE_M,
        _SPREAD,
        _COUNTS_AS,
        _EXPECTED,
        _SECOND_START,
        _MOST_POINTS,
        _MOST_LINES,
        _THICK_M / _TIMES_PIECES,
    ]
)
_MOVED_RADII = 1.1
_MOVED_M, _HALVES_M, _TIMES_THINNER = 0.03, 0.005, 1.15
_AROUND, _AROUND_RADII = 8, 0.75


def onto_trunks(
    seen: Observations,
    outlines: Sequence[Outlines],
    evidence: Callable[[FloatArray], IntArray],
) -> Observations:
    """Return the points with those on strips of thicker wood moved onto its axis.

    Around each place with wood of `THINNEST_M` or more, bark of all views within 5 cm along it
    should lie on a cylinder and outlines touch it: that tells axis and radius, where a strip's
    width says only how much leaves leave of it. A cylinder counts if bark and outlines agree on
    it, few outlines run through it (two branches beside each other have sky between), no view sees
    through it, and it is not much thicker than what pieces show there. Then whatever runs along
    within it is its wood.

    Args:
        seen: points of all views.
        outlines: what each view shows of thick wood, in the order of the views.
        evidence: how many views say what (N, 6) of points (N, 3), see `evidence.count_evidence`.
    """
    tried = np.flatnonzero((seen.radius_m >= THINNEST_M) & ~seen.fragment)
    tried = tried[heaviest(seen.points_in_base[tried], seen.probability[tried], _CELL_M)]
    bark = np.concatenate([np.zeros((0, BARK)), *(one.bark for one in outlines)])
    outline = np.concatenate([np.zeros((0, OUTLINE)), *(one.outline for one in outlines)])
    places = np.column_stack([seen.points_in_base, seen.directions])[tried]
    tall = int(np.ptp(bark[:, :3], axis=0).argmax()) if len(bark) else 0
    bark, bark_window = _windows(bark, places, tall, _REACH_M)
    outline, outline_window = _windows(outline, places, tall, _REACH_M)
    fits = trunks.fits(places, bark, outline, bark_window, outline_window, _LIMITS)
    sure = np.flatnonzero(_agreed(fits, places, seen.radius_m[tried]))
    axes = np.column_stack([fits[sure, :3], places[sure, 3:], fits[sure, 3]])
    axes = axes[_outlined(axes, outline, tall)]
    return _moved(seen, axes[~_seen_through(axes, evidence)])


def _windows(
    lines: FloatArray, places: FloatArray, axis: int, reach_m: float
) -> tuple[FloatArray, IntArray]:
    """Return lines in the order of one coordinate, and which of them are near each place (K, 2)."""
    lines = lines[np.argsort(lines[:, axis], kind="stable")]
    ends = [np.searchsorted(lines[:, axis], places[:, axis] + way) for way in (-reach_m, reach_m)]
    return lines, np.stack(ends, axis=1).astype(np.int64)


def _agreed(fits: FloatArray, places: FloatArray, piece_m: FloatArray) -> BoolArray:
    """Say which fits (K,) are sure enough, and of wood thicker than their piece."""
    radius_m, deviation, on_bark, pieces_m = fits[:, 3:].T
    away_m = np.linalg.norm(fits[:, :3] - places[:, :3], axis=1)
    return np.asarray(
        (radius_m > _THICK_M)
        & (radius_m < _THICKEST_M)
        & (radius_m >= _TIMES_THICKER * piece_m)
        & (radius_m < _TIMES_PIECES * pieces_m)
        & (away_m < _MOVED_RADII * radius_m)
        & (deviation < _DEVIATION)
        & (on_bark > _ON_BARK)
    )


def _outlined(axes: FloatArray, outline: FloatArray, tall: int) -> BoolArray:
    """Say which cylinders (K, 7) outlines around them touch, and few run through."""
    outline, window = _windows(outline, axes, tall, _REACH_M)
    counts = trunks.outlined(
        np.ascontiguousarray(axes[:, :6]), axes[:, 6].copy(), outline, window, _LIMITS
    )
    around, on, through = counts.T
    return np.asarray((on >= _ON_OUTLINES * around) & (through <= _THROUGH * around))


def _seen_through(axes: FloatArray, evidence: Callable[[FloatArray], IntArray]) -> BoolArray:
    """Say which cylinders (K, 7) some place in is empty: on the axis, or around it."""
    directions = axes[:, 3:6]
    helper = np.where(np.abs(directions[:, 2:]) < 0.9, [0.0, 0.0, 1.0], [1.0, 0.0, 0.0])
    first = np.cross(directions, helper)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    second = np.cross(directions, first)
    angle = 2 * np.pi * np.arange(_AROUND) / _AROUND
    ring = np.cos(angle)[:, None, None] * first + np.sin(angle)[:, None, None] * second
    inside = axes[:, :3] + _AROUND_RADII * axes[:, 6:] * np.concatenate([0 * ring[:1], ring])
    empty = is_empty(evidence(np.ascontiguousarray(inside.reshape(-1, 3))))
    return np.asarray(empty.reshape(_AROUND + 1, -1).any(axis=0))


def _moved(seen: Observations, axes: FloatArray) -> Observations:
    """Move what runs along within thicker wood onto its axis (K, 7: centre, direction, radius)."""
    of_masks = np.flatnonzero(~seen.fragment)
    runs = np.column_stack([seen.points_in_base, seen.directions])[of_masks]
    limits = np.array([_MIN_COSINE, _MOVED_M, _MOVED_RADII, _TIMES_THINNER, _HALVES_M])
    places = trunks.onto(runs, seen.radius_m[of_masks], axes, limits)
    moves = places[:, 6] > 0
    points, directions, radius_m = (
        array.copy() for array in (seen.points_in_base, seen.directions, seen.radius_m)
    )
    moved = of_masks[moves]
    points[moved], directions[moved] = places[moves, :3], places[moves, 3:6]
    radius_m[moved] = places[moves, 6]
    return replace(seen, points_in_base=points, directions=directions, radius_m=radius_m)
