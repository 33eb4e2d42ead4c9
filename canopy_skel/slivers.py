"""Slivers of thick wood: strips that leaves cut off a trunk, seen as thin wood beside its axis."""

from dataclasses import replace

import numpy as np
from scipy.spatial import cKDTree

from canopy_skel.fusion import Observations, heaviest
from canopy_skel.geometry import BoolArray, IntArray
from canopy_skel.kernels import bark, fuse

_THICK_M = (0.014, 0.020, 0.028, 0.040, 0.056)
_TIMES_THINNER = 1.3
_INSIDE = 0.9
_MIN_COSINE = 0.8
_NEAREST = 4
_BARK_REACH_M = 0.3
_BARK_RADII = 1.25
_BARK_TIMES_THINNER = 1.2
_BARK_MIN_COSINE = 0.9
_BARK_CELL_M = 0.008
_BARK_SIDE_M = 0.1
_APART_M = 0.02


def on_axis(seen: Observations) -> Observations:
    """Return the points with those on the bark of thicker wood moved onto its axis.

    Where instances show thick wood before and behind, within 30 cm, the wood between is as thick: a
    thin strip within 1.25 radii of both axes and within 26 degrees of them is its bark. It gets
    axis, direction and radius from both sides; the thickest such wood counts.
    """
    thick = np.flatnonzero((seen.radius_m >= _THICK_M[0]) & ~seen.fragment)
    if len(thick) == 0:
        return seen
    thick = thick[heaviest(seen.points_in_base[thick], seen.probability[thick], _BARK_CELL_M)]
    by_place = np.argsort(fuse.cell_keys(seen.points_in_base[thick], _BARK_SIDE_M), kind="stable")
    thick = thick[by_place]
    thin = np.flatnonzero(seen.radius_m < seen.radius_m[thick].max() / _BARK_TIMES_THINNER)
    runs = np.column_stack([seen.points_in_base, seen.directions, seen.radius_m])
    sides = bark.either_side(
        np.ascontiguousarray(runs[thin, :6]),
        seen.radius_m[thin],
        runs[thick],
        np.array(_THICK_M[::-1]),
        np.array([_BARK_REACH_M, _BARK_RADII, _BARK_TIMES_THINNER, _BARK_MIN_COSINE]),
    )
    known = sides[:, 0, 0] >= 0
    return _moved(seen, thin[known], np.where(sides >= 0, thick[sides], -1)[known])


def _moved(seen: Observations, thin: IntArray, sides: IntArray) -> Observations:
    """Move thin points (T,) onto the line between what lies before and behind (T, 2, K)."""
    share = np.where(sides >= 0, seen.probability[sides], 0.0)
    share /= share.sum(axis=2, keepdims=True)
    ends = np.einsum("tsk,tskc->tsc", share, seen.points_in_base[sides])
    radius_m = np.einsum("tsk,tsk->ts", share, seen.radius_m[sides])
    points, way = seen.points_in_base[thin], ends[:, 1] - ends[:, 0]
    far = np.linalg.norm(way, axis=1) >= _APART_M
    axis = np.where(far[:, None], way, seen.directions[thin])
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    start = np.where(far[:, None], ends[:, 0], ends.mean(axis=1))
    onto = start + np.sum((points - start) * axis, axis=1, keepdims=True) * axis
    away_m = np.linalg.norm(points[:, None] - ends, axis=2) + 1e-9
    thickness_m = np.sum(radius_m / away_m, axis=1) / np.sum(1.0 / away_m, axis=1)
    moves = np.linalg.norm(onto - points, axis=1) < _BARK_RADII * thickness_m
    moved = thin[moves]
    fields = (seen.points_in_base, seen.directions, seen.radius_m, seen.probable_radius_m)
    place, direction, thick, probable = (array.copy() for array in fields)
    place[moved], direction[moved] = onto[moves], axis[moves]
    thick[moved] = probable[moved] = thickness_m[moves]
    return replace(
        seen,
        points_in_base=place,
        directions=direction,
        radius_m=thick,
        probable_radius_m=probable,
    )


def inside_thicker(seen: Observations) -> BoolArray:
    """Say which points (N,) run along within wood that an instance shows to be thicker.

    No other wood can be there: across the axis of the thicker one they lie within nine tenths of
    its radius, in a direction within 37 degrees of its own.
    """
    swallowed = np.zeros(len(seen.points_in_base), dtype=np.bool_)
    for thick_m in _THICK_M:
        thick = np.flatnonzero((seen.radius_m >= thick_m) & ~seen.fragment & ~swallowed)
        thin = np.flatnonzero((seen.radius_m < thick_m / _TIMES_THINNER) & ~swallowed)
        if len(thick) >= _NEAREST and len(thin):
            swallowed[_within(seen, thin, thick, 1.5 * thick_m)] = True
    return swallowed


def _within(seen: Observations, thin: IntArray, thick: IntArray, reach_m: float) -> IntArray:
    """Return which of the thin points (T,) lie within the wood of one of the nearest thick ones."""
    points = seen.points_in_base
    distance_m, nearest = map(
        np.asarray,
        cKDTree(points[thick]).query(points[thin], k=_NEAREST, distance_upper_bound=reach_m),
    )
    some = np.isfinite(distance_m[:, 0])  # Few have any.
    thin, near = thin[some], np.isfinite(distance_m[some])
    other = thick[np.where(near, nearest[some], 0)]
    offset, axis = points[thin][:, None] - points[other], seen.directions[other]
    along_m = np.sum(offset * axis, axis=2)
    across_m = np.linalg.norm(offset - along_m[..., None] * axis, axis=2)
    parallel = np.abs(np.sum(seen.directions[thin][:, None] * axis, axis=2)) >= _MIN_COSINE
    radius_m = seen.radius_m[other]
    inside = (across_m < _INSIDE * radius_m) & (np.abs(along_m) < radius_m)
    return np.asarray(thin[(near & parallel & inside).any(axis=1)])
