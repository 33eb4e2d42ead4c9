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
_TANGENT_CELLS = 12


@dataclass(frozen=True, kw_only=True, eq=False, slots=True)
class _Ends:
    """Both ends of N paths; 2k is the first of path k.

    place: (2N, 2) row and column. tangent: (2N, 2) unit, outwards. log_radius: (2N,) in cells.
    """

    place: FloatArray
    tangent: FloatArray
    log_radius: FloatArray


def joined(paths: list[I32], log_radius: Float32Array, rule: F64) -> list[I32]:
    """Join paths (N, 2: row and column) end to end, the best aligned first.

    rule: see `strands.bend`; what is joined has no bend.
    """
    paths = list(paths)
    if len(paths) < 2:
        return paths
    ends = _ends_of(paths, log_radius)
    home = np.arange(len(paths))
    free = np.ones(2 * len(paths), dtype=bool)
    for a, b in _candidates(ends):
        one, other = home[a // 2], home[b // 2]
        if one == other or not (free[a] and free[b]):
            continue
        path = _concatenated(paths[one], paths[other], ends.place[a], ends.place[b])
        radius = float(np.exp(log_radius[path[:, 0], path[:, 1]].mean()))
        if strands.bend(path, radius, rule) >= 0:
            continue
        paths[one], paths[other] = path, path[:0]
        home[home == other] = one
        free[[a, b]] = False
    return [path for path in paths if len(path)]


def _ends_of(paths: list[I32], log_radius: Float32Array) -> _Ends:
    place, tangent, radius = [], [], []
    for path in paths:
        for own in (path, path[::-1]):
            inner = own[min(_TANGENT_CELLS, len(own) - 1)]
            out = (own[0] - inner).astype(np.float64)
            place.append(own[0].astype(np.float64))
            tangent.append(out / max(float(np.linalg.norm(out)), 1e-9))
            radius.append(log_radius[path[:, 0], path[:, 1]].mean())
    return _Ends(
        place=np.array(place), tangent=np.array(tangent), log_radius=np.array(radius, np.float64)
    )


def _candidates(ends: _Ends) -> IntArray:
    """Return (M, 2) pairs of ends that may go on in each other, the best first."""
    radius = np.exp(ends.log_radius)
    near = max(_GAP_CELLS, _GAP_RADII * float(radius.max()))
    # A tree, not all pairs: a large picture has tens of thousands of ends.
    pairs = cKDTree(ends.place).query_pairs(near, output_type="ndarray")
    pairs = pairs[pairs[:, 0] // 2 < pairs[:, 1] // 2]
    pairs = pairs[np.lexsort(pairs.T[::-1])].astype(np.int64)
    a, b = pairs.T
    gap = ends.place[b] - ends.place[a]
    distance = np.linalg.norm(gap, axis=1)
    thin = np.minimum(radius[a], radius[b])
    cosine = -np.sum(ends.tangent[a] * ends.tangent[b], axis=1)
    fits = distance <= np.maximum(_GAP_CELLS, _GAP_RADII * thin)
    for tangent, way in ((ends.tangent[a], gap), (ends.tangent[b], -gap)):
        along = np.sum(way * tangent, axis=1)
        aside = np.sqrt(np.maximum(distance**2 - along**2, 0.0))
        fits &= (aside <= np.maximum(_ASIDE_CELLS, _ASIDE_RADII * thin)) & (along > -thin)
    fits &= cosine >= np.cos(np.radians(_TURN_DEG))
    fits &= np.abs(ends.log_radius[a] - ends.log_radius[b]) <= _RATIO
    cost = distance[fits] + 30.0 * (1.0 - cosine[fits])
    return np.asarray(pairs[fits][np.argsort(cost, kind="stable")])


def _concatenated(one: I32, other: I32, from_place: FloatArray, to_place: FloatArray) -> I32:
    """Put two paths into one, so that the given ends meet."""
    first = one if np.array_equal(one[-1], from_place) else one[::-1]
    second = other if np.array_equal(other[0], to_place) else other[::-1]
    return np.ascontiguousarray(np.concatenate([first, second]))
