"""Slivers of thick wood: strips that leaves cut off a trunk, seen as thin wood beside its axis."""

import numpy as np
from scipy.spatial import cKDTree

from canopy_skel.fusion import Observations
from canopy_skel.geometry import BoolArray, IntArray

_THICK_M = (0.014, 0.020, 0.028, 0.040, 0.056)
_TIMES_THINNER = 1.3
_INSIDE = 0.9
_MIN_COSINE = 0.8
_NEAREST = 4


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
