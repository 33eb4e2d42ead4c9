"""Pieces of a middle line that go on in each other are joined: across forks and small gaps."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from canopy_skel.frame import Float32Array
from canopy_skel.geometry import FloatArray, IntArray
from canopy_skel.kernels import strands
from canopy_skel.kernels.strands import F64, I32

_TURN_DEG = 18.0
_GAP_CELLS = 8.0
_GAP_RADII = 1.5
_ASIDE_RADII = 0.5
_ASIDE_CELLS = 1.5
_RATIO = 0.6
_BACK_CELLS = 12.0
_BESIDE_CELLS = 3.0
_BESIDE_TURN_DEG = 25.0
_BESIDE_RATIO = 0.4
_TANGENT_CELLS = 24
_WAY_CELLS = 12


@dataclass(frozen=True, kw_only=True, eq=False, slots=True)
class _Ends:
    """Both ends of N paths; 2k is the first of path k.

    place: (2N, 2) row and column. tangent: (2N, 2) unit, outwards. log_radius: (2N,) in cells.
    """

    place: FloatArray
    tangent: FloatArray
    log_radius: FloatArray


def joined(paths: list[I32], field: Float32Array, rule: F64) -> list[I32]:
    """Join paths (N, 2: row and column) end to end, the best aligned first.

    field: (3, h, w) cos 2θ, sin 2θ, log radius in cells. rule: see `strands.bend`; what is joined
    has no bend.
    """
    paths = list(paths)
    if len(paths) < 2:
        return paths
    ends = _ends_of(paths, field)
    home = np.arange(len(paths))
    free = np.ones(2 * len(paths), dtype=bool)
    for a, b in _candidates(ends):
        one, other = home[a // 2], home[b // 2]
        if one == other or not (free[a] and free[b]):
            continue
        path = _concatenated(paths[one], paths[other], ends.place[a], ends.place[b])
        radius = float(np.exp(field[2, path[:, 0], path[:, 1]].mean()))
        if strands.bend(path, radius, rule) >= 0:
            continue
        paths[one], paths[other] = path, path[:0]
        home[home == other] = one
        free[[a, b]] = False
    return [path for path in paths if len(path)]


def _ends_of(paths: list[I32], field: Float32Array) -> _Ends:
    ways = [own for path in paths for own in (path, path[::-1])]
    cosine, sine = _means(field[:2], [way[:_TANGENT_CELLS] for way in ways])
    (log_radius,) = _means(field[2:3], paths)
    place = np.array([way[0] for way in ways], dtype=np.float64)
    inner = np.array([way[min(_WAY_CELLS, len(way) - 1)] for way in ways])
    return _Ends(
        place=place,
        tangent=_outwards(cosine, sine, place - inner),
        log_radius=np.repeat(log_radius, 2),
    )


def _means(field: Float32Array, groups: list[I32]) -> FloatArray:
    """Return the means (K, N) of maps (K, h, w) over N groups of cells."""
    row, column = np.concatenate(groups).T
    counts = np.array([len(group) for group in groups])
    sums = np.add.reduceat(field[:, row, column], np.cumsum(counts) - counts, axis=1)
    return np.asarray(sums / counts)


def _outwards(cosine: FloatArray, sine: FloatArray, way: FloatArray) -> FloatArray:
    """Return the directions (N, 2: row, column) of the field that go the given way (N, 2) at all.

    The field is steadier than the line: thinning bends its ends.
    """
    angle = 0.5 * np.arctan2(sine, cosine)
    tangent = np.stack([np.sin(angle), np.cos(angle)], axis=1)
    back = (tangent * way).sum(axis=1) < 0
    return np.where(back[:, None], -tangent, tangent)


@dataclass(frozen=True, kw_only=True, eq=False, slots=True)
class _Pairs:
    """How M pairs of ends (M, 2) lie to each other; lengths in cells, (M,) each.

    along, aside: from either end to the other, the worse of the two. radius: the smaller one.
    ratio: of the radii, logarithmic.
    """

    ends: IntArray
    distance: FloatArray
    along: FloatArray
    aside: FloatArray
    turn_deg: FloatArray
    radius: FloatArray
    ratio: FloatArray


def _pairs_of(ends: _Ends) -> _Pairs:
    """Compare ends that are near each other; all pairs of a large picture would fill the memory."""
    radius = np.exp(ends.log_radius)
    near = max(_GAP_CELLS, _BACK_CELLS + _BESIDE_CELLS, _GAP_RADII * float(radius.max()))
    pairs = cKDTree(ends.place).query_pairs(near, output_type="ndarray")
    pairs = pairs[pairs[:, 0] // 2 < pairs[:, 1] // 2]
    pairs = pairs[np.lexsort(pairs.T[::-1])].astype(np.int64)
    a, b = pairs.T
    gap = ends.place[b] - ends.place[a]
    distance = np.linalg.norm(gap, axis=1)
    along = np.stack([(gap * ends.tangent[a]).sum(axis=1), (-gap * ends.tangent[b]).sum(axis=1)])
    aside = np.sqrt(np.maximum(distance**2 - along**2, 0.0))
    cosine = -np.sum(ends.tangent[a] * ends.tangent[b], axis=1)
    return _Pairs(
        ends=pairs,
        distance=distance,
        along=along.min(axis=0),
        aside=aside.max(axis=0),
        turn_deg=np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))),
        radius=np.minimum(radius[a], radius[b]),
        ratio=np.abs(ends.log_radius[a] - ends.log_radius[b]),
    )


def _candidates(ends: _Ends) -> IntArray:
    """Return (M, 2) pairs of ends that may go on in each other, the best first.

    Either one follows on the other, or they run side by side for a bit, as thinned lines do where a
    branch is wide or touches another.
    """
    pairs = _pairs_of(ends)
    wide = np.maximum(_ASIDE_CELLS, _ASIDE_RADII * pairs.radius)
    follows = pairs.distance <= np.maximum(_GAP_CELLS, _GAP_RADII * pairs.radius)
    follows &= (pairs.aside <= wide) & (pairs.along > -pairs.radius)
    follows &= (pairs.turn_deg <= _TURN_DEG) & (pairs.ratio <= _RATIO)
    beside = (pairs.along <= 0) & (pairs.along >= -_BACK_CELLS)
    beside &= pairs.aside <= np.maximum(_BESIDE_CELLS, wide)
    beside &= (pairs.turn_deg <= _BESIDE_TURN_DEG) & (pairs.ratio <= _BESIDE_RATIO)
    fits = follows | beside
    cost = pairs.distance[fits] + 30.0 * (1.0 - np.cos(np.radians(pairs.turn_deg[fits])))
    return np.asarray(pairs.ends[fits][np.argsort(cost, kind="stable")])


def _concatenated(one: I32, other: I32, from_place: FloatArray, to_place: FloatArray) -> I32:
    """Put two paths into one, so that the given ends meet."""
    first = one if np.array_equal(one[-1], from_place) else one[::-1]
    second = other if np.array_equal(other[0], to_place) else other[::-1]
    way = first[-1] - first[-min(_WAY_CELLS, len(first))]
    if way.any():  # what of the second runs beside the first is left out
        second = second[np.logical_or.accumulate((second - first[-1]) @ way > 0)]
    return np.ascontiguousarray(np.concatenate([first, second]))
