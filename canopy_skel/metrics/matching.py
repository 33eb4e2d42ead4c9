"""Which pieces of one skeleton have a counterpart in another."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from canopy_skel.geometry import BoolArray, FloatArray, IntArray
from canopy_skel.metrics.pieces import Pieces

Accept = Callable[[IntArray, IntArray], BoolArray]
_POINTS_AT_ONCE = 4096
_ZERO_SQUARE = 1e-24


def nearest(points: FloatArray, targets: FloatArray, reach_m: float) -> tuple[FloatArray, IntArray]:
    """Return the distance (N,) of each point to the nearest target, and which one (N,).

    Where no target is within `reach_m` the distance is infinite and the index 0.
    """
    if len(points) == 0 or len(targets) == 0:
        return np.full(len(points), np.inf), np.zeros(len(points), dtype=np.int64)
    found = cKDTree(targets).query(points, distance_upper_bound=reach_m * (1 + 1e-9))
    distance_m = np.asarray(found[0], dtype=np.float64)
    distance_m[distance_m > reach_m] = np.inf
    index = np.where(np.isfinite(distance_m), found[1], 0)
    return distance_m, index.astype(np.int64)


@dataclass(frozen=True, kw_only=True, eq=False, slots=True)
class Feet:
    """Where each of N points meets a curve: the nearest point of its edges.

    distance_m: (N,), infinite where the curve is out of reach. ends: (N, 2) vertices of the edge;
    fraction: (N,) where between them.
    """

    distance_m: FloatArray
    ends: IntArray
    fraction: FloatArray

    def blend(self, per_vertex: FloatArray) -> FloatArray:
        """Interpolate a value of the curve's vertices (V,) at the feet (N,)."""
        start, end = per_vertex[self.ends[:, 0]], per_vertex[self.ends[:, 1]]
        return start + self.fraction * (end - start)


def feet_on(points: FloatArray, curve: Pieces, positions: FloatArray, reach_m: float) -> Feet:
    """Drop points (N, 3) onto a curve given by fine pieces of edges between `positions` (V, 3).

    The edges of the eight nearest pieces are tried, which misses the nearest edge by less than
    the curve's own sampling, and only where several are almost equally near. A curve whose pieces
    are all further than `reach_m` is out of reach.
    """
    distance_m = np.full(len(points), np.inf)
    ends = np.zeros((len(points), 2), dtype=np.int64)
    fraction = np.zeros(len(points))
    if len(points) == 0 or len(curve.points) == 0:
        return Feet(distance_m=distance_m, ends=ends, fraction=fraction)
    tried = np.arange(1, min(8, len(curve.points)) + 1)
    near = cKDTree(curve.points).query(points, k=tried, distance_upper_bound=reach_m)[1]
    for rank in range(len(tried)):
        some = np.flatnonzero(np.asarray(near)[:, rank] < len(curve.points))
        edge = curve.ends[np.asarray(near)[some, rank]]
        start, along = positions[edge[:, 0]], positions[edge[:, 1]] - positions[edge[:, 0]]
        square = np.einsum("ij,ij->i", along, along)
        product = np.einsum("ij,ij->i", points[some] - start, along)
        at = np.clip(product / np.maximum(square, _ZERO_SQUARE), 0.0, 1.0)
        this_m = np.linalg.norm(points[some] - start - at[:, None] * along, axis=1)
        nearer = this_m < distance_m[some]
        distance_m[some[nearer]], fraction[some[nearer]] = this_m[nearer], at[nearer]
        ends[some[nearer]] = edge[nearer]
    return Feet(distance_m=distance_m, ends=ends, fraction=fraction)


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
    distance_m, index = nearest(points, targets, radius_m)
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
    least = np.cos(np.radians(degrees)) - 1e-9  # diagonals of a voxel grid lie at 45 exactly

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
