"""Joins between observed parts by calibrated probability (mode `canopy`)."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from canopy_skel.ends import Ends
from canopy_skel.evidence import BACKGROUND, HIDDEN, LEAF, THROUGH, WOOD, is_empty
from canopy_skel.geometry import BoolArray, FloatArray, IntArray
from canopy_skel.kernels import candidates as kernel

Evidence = Callable[[FloatArray], IntArray]
"""Points (N, 3) -> counts of verdicts (N, 6)."""
Cost = Callable[[FloatArray], FloatArray]
"""Points (N, 3) -> -log p of the likelihood map (N,)."""


@dataclass(frozen=True, kw_only=True, slots=True)
class LinkConfig:
    """Links of at most `reach_m` and of probability at least `min_probability` are made.

    To or from a fragment, whose direction is less sure, `min_fragment_probability` counts. A link
    more than `max_empty` of which runs where nothing can be is not made, whatever its probability.
    Of each end the `candidates` best are asked; curves are drawn every `spacing_m`.
    """

    reach_m: float = 0.25
    max_empty: float = 0.3
    min_probability: float = 0.4
    min_fragment_probability: float = 0.6
    candidates: int = 6
    spacing_m: float = 0.008


@dataclass(frozen=True, kw_only=True, eq=False, slots=True)
class Candidates:
    """Possible links: from end `end` to vertex `vertex`, at its end `other` or (-1) at its side.

    curves: (L, n, 3) points on each, both ends included; features: (L, F). gap_m: (L,) between
    what it joins; lips: (L, 2) the confidences of that; empty: (L,) the share of it that runs where
    nothing can be.
    """

    end: IntArray
    vertex: IntArray
    other: IntArray
    curves: FloatArray
    features: FloatArray
    gap_m: FloatArray
    lips: FloatArray
    empty: FloatArray


@dataclass(frozen=True, kw_only=True, eq=False, slots=True)
class Places:
    """Places on links that were made, in rows: points (N, 3), features (N, F).

    first: (L + 1,) the places on link k are first[k] : first[k + 1].
    """

    points: FloatArray
    features: FloatArray
    first: IntArray


@dataclass(frozen=True, kw_only=True, eq=False, slots=True)
class Parts:
    """What is to be joined.

    points, directions: (V, 3). component: (V,). length_m: (V,), of the component. confidence,
    radius_m (of the pixels, which is what the models know), probable_radius_m (what the wood has),
    fragment (seen more in fragments than in instances): (V,). ends: the free ends.
    """

    points: FloatArray
    directions: FloatArray
    component: IntArray
    length_m: FloatArray
    confidence: FloatArray
    radius_m: FloatArray
    probable_radius_m: FloatArray
    fragment: BoolArray
    ends: Ends


_SAMPLES = 17
_PLACE_FEATURES = 5


def candidates_of(
    parts: Parts, evidence: Evidence, cost: Cost, config: LinkConfig, reach_m: float | None = None
) -> Candidates:
    """Return the links worth asking about, with what speaks for and against each."""
    ends = parts.ends
    vertex_end = np.full((len(parts.points), 2), -1, dtype=np.int64)
    for number, v in enumerate(ends.vertex.tolist()):
        vertex_end[v, int(vertex_end[v, 0] >= 0)] = number
    count = int(parts.component.max(initial=-1)) + 1
    end, vertex, other, rank = kernel.link_candidates(
        parts.points[ends.vertex],
        ends.tangents,
        parts.component[ends.vertex],
        vertex_end,
        parts.points,
        parts.component,
        count,
        reach_m or config.reach_m,
        config.candidates,
    )
    curves = _curves(parts, end, vertex, other)
    counts = evidence(curves[:, 1:-1].reshape(-1, 3))
    shares = _shares(counts, len(end))
    start = parts.ends.vertex[end]
    return Candidates(
        end=end,
        vertex=vertex,
        other=other,
        curves=curves,
        features=_features(parts, end, vertex, other, rank, curves, shares, cost),
        gap_m=np.linalg.norm(parts.points[vertex] - parts.points[start], axis=1),
        lips=parts.confidence[np.column_stack([start, vertex])],
        empty=is_empty(counts).reshape(len(end), _SAMPLES - 2).mean(axis=1),
    )


def _curves(parts: Parts, end: IntArray, vertex: IntArray, other: IntArray) -> FloatArray:
    """Return cubic Hermite curves (L, n, 3), tangents 0.8 gaps long; straight into a side."""
    start, goal = parts.points[parts.ends.vertex[end]], parts.points[vertex]
    gap = goal - start
    length = np.linalg.norm(gap, axis=1, keepdims=True)
    straight = gap / np.maximum(length, 1e-9)
    leaving = 0.8 * length * parts.ends.tangents[end]
    arriving = np.where(other[:, None] >= 0, -parts.ends.tangents[other], straight) * 0.8 * length
    t = np.linspace(0.0, 1.0, _SAMPLES)[None, :, None]
    return np.asarray(
        (2 * t**3 - 3 * t**2 + 1) * start[:, None]
        + (t**3 - 2 * t**2 + t) * leaving[:, None]
        + (3 * t**2 - 2 * t**3) * goal[:, None]
        + (t**3 - t**2) * arriving[:, None]
    )


def _features(
    parts: Parts,
    end: IntArray,
    vertex: IntArray,
    other: IntArray,
    rank: FloatArray,
    curves: FloatArray,
    shares: FloatArray,
    cost: Cost,
) -> FloatArray:
    start = parts.ends.vertex[end]
    gap = parts.points[vertex] - parts.points[start]
    length = np.maximum(np.linalg.norm(gap, axis=1), 1e-9)
    way = gap / length[:, None]
    cos_a = np.sum(way * parts.ends.tangents[end], axis=1)
    cos_b = -np.sum(way * parts.ends.tangents[other], axis=1)
    side = np.abs(np.sum(way * parts.directions[vertex], axis=1))
    at_end = other >= 0
    nats = cost(curves[:, 1:-1].reshape(-1, 3)).reshape(len(end), _SAMPLES - 2)
    radii = np.log(np.maximum(parts.radius_m, 1e-4))
    return np.column_stack(
        [
            np.log(length + 0.005),
            length,
            cos_a,
            np.where(at_end, cos_b, 0.0),
            at_end,
            np.where(at_end, 0.0, side),
            shares,
            nats.mean(axis=1),
            nats.max(axis=1, initial=0.0),
            np.log(parts.length_m[start] + 0.01),
            np.log(parts.length_m[vertex] + 0.01),
            parts.confidence[start],
            parts.confidence[vertex],
            radii[start],
            radii[vertex],
            np.log(rank + 0.005),
            np.abs(radii[start] - radii[vertex]),
        ]
    )


def _shares(counts: IntArray, links: int) -> FloatArray:
    """Return per link the shares of its points that are empty, wood, leaf or hidden in any view."""
    flags = np.column_stack(
        [
            is_empty(counts),
            counts[:, WOOD] > 0,
            counts[:, LEAF] > 0,
            counts[:, HIDDEN] > 0,
            counts[:, THROUGH] + counts[:, BACKGROUND] > 1,
        ]
    )
    return np.asarray(flags.reshape(links, _SAMPLES - 2, 5).mean(axis=1))


def links_to_make(
    parts: Parts, candidates: Candidates, probability: FloatArray, config: LinkConfig
) -> IntArray:
    """Return which candidates become links, of their probabilities (L,)."""
    of_end = parts.ends.vertex
    fragment = parts.fragment[of_end[candidates.end]] | parts.fragment[candidates.vertex]
    limit = np.where(fragment, config.min_fragment_probability, config.min_probability)
    allowed = probability >= limit
    allowed &= candidates.empty <= config.max_empty
    return forest_of(candidates, probability, allowed, parts.component, parts.component[of_end])


def forest_of(
    candidates: Candidates,
    probability: FloatArray,
    allowed: BoolArray,
    component: IntArray,
    of_end: IntArray,
) -> IntArray:
    """Return which of the allowed links (L,) are made: Kruskal on falling probability.

    component: (V,); of_end: (K,), the component of each end. Independent links given, that is the
    most likely forest. An end may have several: behind the leaves it may fork. Ties fall by gap,
    then by number.
    """
    parent = list(range(int(component.max(initial=-1)) + 1))

    def root(c: int) -> int:
        while parent[c] != c:
            parent[c] = parent[parent[c]]
            c = parent[c]
        return c

    order = np.lexsort((candidates.gap_m, -probability))
    chosen = []
    for i in order[allowed[order]].tolist():
        a = root(int(of_end[candidates.end[i]]))
        b = root(int(component[candidates.vertex[i]]))
        if a != b:
            parent[a] = b
            chosen.append(i)
    return np.array(chosen, dtype=np.int64)


def places_on(
    candidates: Candidates, made: IntArray, probability: FloatArray, spacing_m: float
) -> Places:
    """Return the inner places on the links made, of the probabilities (L,) of all candidates.

    A link was chosen from many, and may be right at its lips and wrong in its middle: so a place
    has a probability of its own.
    """
    points, features = [np.zeros((0, 3))], [np.zeros((0, _PLACE_FEATURES))]
    for i in made.tolist():
        inner, length_m = evenly(candidates.curves[i], spacing_m)
        gone_m = length_m * np.arange(1, len(inner) + 1) / (len(inner) + 1)
        lips_m = np.sort(np.column_stack([gone_m, length_m - gone_m]), axis=1)
        p = min(max(float(probability[i]), 1e-3), 1.0 - 1e-3)
        of_link = [np.log(p / (1.0 - p)), *candidates.lips[i]]
        points.append(inner)
        features.append(np.column_stack([np.tile(of_link, (len(inner), 1)), lips_m]))
    return Places(
        points=np.concatenate(points),
        features=np.concatenate(features),
        first=np.cumsum([len(row) for row in points]),
    )


def evenly(curve: FloatArray, spacing_m: float) -> tuple[FloatArray, float]:
    """Return points within a polyline (n, 3), no further apart than `spacing_m`, and its length."""
    length = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(curve, axis=0), axis=1)))
    count = max(2, int(np.ceil(length[-1] / spacing_m)) + 1)
    at = np.linspace(0.0, length[-1], count)[1:-1]
    return np.column_stack([np.interp(at, length, column) for column in curve.T]), length[-1]
