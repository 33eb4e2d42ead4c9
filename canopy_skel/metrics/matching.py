"""Which pieces of one skeleton have a counterpart in another."""

from collections.abc import Callable

import numpy as np
from scipy.spatial import cKDTree

from canopy_skel.geometry import BoolArray, FloatArray, IntArray

Accept = Callable[[IntArray, IntArray], BoolArray]
_POINTS_AT_ONCE = 4096


def nearest(points: FloatArray, targets: FloatArray) -> tuple[FloatArray, IntArray]:
    """Return the distance (N,) of each point to the nearest target, and which one (N,).

    Without targets the distance is infinite and the index 0.
    """
    if len(points) == 0 or len(targets) == 0:
        return np.full(len(points), np.inf), np.zeros(len(points), dtype=np.int64)
    distance_m, index = cKDTree(targets).query(points)
    return np.asarray(distance_m, dtype=np.float64), np.asarray(index, dtype=np.int64)


def any_within(
    points: FloatArray, targets: FloatArray, radius_m: float, accept: Accept
) -> BoolArray:
    """Say for each point (N,) whether some target within `radius_m` is accepted.

    Args:
        points: (N, 3).
        targets: (M, 3).
        radius_m: how far to look.
        accept: called with (P,) indices of points and (P,) of targets; says which pairs (P,) hold.
    """
    distance_m, index = nearest(points, targets)
    hit = distance_m <= radius_m
    near = np.flatnonzero(hit)
    hit[near] = accept(near, index[near])
    open_points = near[~hit[near]]
    if len(open_points) == 0:
        return hit
    tree = cKDTree(targets)
    for first in range(0, len(open_points), _POINTS_AT_ONCE):
        some = open_points[first : first + _POINTS_AT_ONCE]
        found = [np.asarray(one) for one in tree.query_ball_point(points[some], radius_m)]
        of = np.repeat(some, [len(one) for one in found])
        pairs = np.concatenate(found).astype(np.int64)
        hit[of[accept(of, pairs)]] = True
    return hit


def parallel(directions: FloatArray, target_directions: FloatArray, degrees: float) -> Accept:
    """Accept pairs whose undirected directions (N, 3), (M, 3) differ by at most `degrees`."""
    least = np.cos(np.radians(degrees))

    def accept(point: IntArray, target: IntArray) -> BoolArray:
        cosine = np.einsum("ij,ij->i", directions[point], target_directions[target])
        return np.asarray(np.abs(cosine) >= least)

    return accept


def beside(points: FloatArray, directions: FloatArray, targets: FloatArray) -> Accept:
    """Accept targets that lie beside a point (|cos| to its direction < 0.5) or within 2 mm of it.

    The test of the authors' evaluation code: past a tip no truth lies beside.
    """

    def accept(point: IntArray, target: IntArray) -> BoolArray:
        offset = targets[target] - points[point]
        distance_m = np.linalg.norm(offset, axis=1)
        along_m = np.abs(np.einsum("ij,ij->i", offset, directions[point]))
        return np.asarray((along_m < 0.5 * distance_m) | (distance_m < 0.002))

    return accept


def share(chosen: BoolArray, weight: FloatArray, among: BoolArray | None = None) -> float | None:
    """Return the share of weight (N,) that is chosen (N,), of all or `among`; None of nothing."""
    if among is not None:
        chosen, weight = chosen[among], weight[among]
    total = float(weight.sum())
    return float(weight[chosen].sum()) / total if total > 0 else None
