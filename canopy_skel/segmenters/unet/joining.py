"""Pieces of a middle line that go on in each other are joined: across forks and small gaps."""

from dataclasses import dataclass

import numpy as np

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
    gap = ends.place[None] - ends.place[:, None]
    distance = np.linalg.norm(gap, axis=2)
    radius = np.exp(np.minimum(ends.log_radius[:, None], ends.log_radius[None]))
    along = np.einsum("abk,ak->ab", gap, ends.tangent)
    aside = np.sqrt(np.maximum(distance**2 - along**2, 0.0))
    cosine = -ends.tangent @ ends.tangent.T
    fits = distance <= np.maximum(_GAP_CELLS, _GAP_RADII * radius)
    fits &= (aside <= np.maximum(_ASIDE_CELLS, _ASIDE_RADII * radius)) & (along > -radius)
    fits &= cosine >= np.cos(np.radians(_TURN_DEG))
    fits &= np.abs(ends.log_radius[:, None] - ends.log_radius[None]) <= _RATIO
    a, b = np.nonzero(fits & fits.T)
    a, b = a[a // 2 < b // 2], b[a // 2 < b // 2]
    cost = distance[a, b] + 30.0 * (1.0 - cosine[a, b])
    return np.stack([a, b], axis=1)[np.argsort(cost, kind="stable")]


def _concatenated(one: I32, other: I32, from_place: FloatArray, to_place: FloatArray) -> I32:
    """Put two paths into one, so that the given ends meet."""
    first = one if np.array_equal(one[-1], from_place) else one[::-1]
    second = other if np.array_equal(other[0], to_place) else other[::-1]
    return np.ascontiguousarray(np.concatenate([first, second]))
