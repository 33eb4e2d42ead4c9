"""Joins between observed parts by calibrated probability (mode `canopy`)."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from canopy_skel.ends import Ends
from canopy_skel.evidence import BACKGROUND, HIDDEN, LEAF, THROUGH, WOOD, is_empty
from canopy_skel.geometry import BoolArray, FloatArray, IntArray
from canopy_skel.kernels.candidates import link_candidates

Evidence = Callable[[FloatArray], IntArray]
"""Points (N, 3) -> counts of verdicts (N, 6)."""
Cost = Callable[[FloatArray], FloatArray]
"""Points (N, 3) -> -log p of the likelihood map (N,)."""


@dataclass(frozen=True, kw_only=True, slots=True)
class LinkConfig:
    """Links of at most `reach_m` and of probability at least `min_probability` are made.

    A link more than `max_empty` of which runs where nothing can be is not made, whatever its
    probability. Of each end the `candidates` best are asked; curves are drawn every `spacing_m`.
    """

    reach_m: float = 0.25
    max_empty: float = 0.3
    min_probability: float = 0.4
    candidates: int = 6
    spacing_m: float = 0.008


@dataclass(frozen=True, kw_only=True, eq=False, slots=True)
class Candidates:
    """Possible links: from end `end` to vertex `vertex`, at its end `other` or (-1) at its side.

    curves: (L, n, 3) points on each, both ends included; features: (L, F).
    """

    end: IntArray
    vertex: IntArray
    other: IntArray
    curves: FloatArray
    features: FloatArray


@dataclass(frozen=True, kw_only=True, eq=False, slots=True)
class Parts:
    """What is to be joined.

    points, directions: (V, 3). component: (V,). length_m: (V,), of the component. confidence,
    radius_m, fragment (seen more in fragments than in instances): (V,). ends: the free ends.
    """

    points: FloatArray
    directions: FloatArray
    component: IntArray
    length_m: FloatArray
    confidence: FloatArray
    radius_m: FloatArray
    fragment: BoolArray
    ends: Ends


_SAMPLES = 17
_EMPTY_SHARE = 6
"""Its column among the features of a link."""


def candidates_of(
    parts: Parts, evidence: Evidence, cost: Cost, config: LinkConfig, reach_m: float | None = None
) -> Candidates:
    """Return the links worth asking about, with what speaks for and against each."""
    ends = parts.ends
    vertex_end = np.full((len(parts.points), 2), -1, dtype=np.int64)
    for number, v in enumerate(ends.vertex.tolist()):
        vertex_end[v, int(vertex_end[v, 0] >= 0)] = number
    count = int(parts.component.max(initial=-1)) + 1
    end, vertex, other, rank = link_candidates(
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
    features = _features(parts, end, vertex, other, rank, curves, evidence, cost)
    return Candidates(end=end, vertex=vertex, other=other, curves=curves, features=features)


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
    evidence: Evidence,
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
    inner = curves[:, 1:-1].reshape(-1, 3)
    counts = evidence(inner)
    shares = _shares(counts, len(end))
    nats = cost(inner).reshape(len(end), _SAMPLES - 2)
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
            np.log(np.maximum(parts.radius_m[start], 1e-4)),
            np.log(np.maximum(parts.radius_m[vertex], 1e-4)),
            np.log(rank + 0.005),
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


def possible(candidates: Candidates, probability: FloatArray, max_empty: float) -> FloatArray:
    """Return the probabilities (L,), 0 of links through places that were seen to be empty."""
    return np.where(candidates.features[:, _EMPTY_SHARE] > max_empty, 0.0, probability)


def accepted(
    candidates: Candidates,
    probability: FloatArray,
    component: IntArray,
    of_end: IntArray,
    min_probability: float,
) -> IntArray:
    """Return the links to make: Kruskal on falling probability, each end used once.

    Independent links given, that is the most likely forest. Ties fall by gap, then by number.
    """
    parent = list(range(int(component.max(initial=-1)) + 1))

    def root(c: int) -> int:
        while parent[c] != c:
            parent[c] = parent[parent[c]]
            c = parent[c]
        return c

    order = np.lexsort((candidates.features[:, 1], -probability))
    used: set[int] = set()
    chosen = []
    for i in order.tolist():
        if probability[i] < min_probability:
            break
        end, other = int(candidates.end[i]), int(candidates.other[i])
        if end in used or other in used:
            continue
        from_vertex = int(candidates.vertex[i])
        a = root(int(of_end[end]))
        b = root(int(component[from_vertex]))
        if a == b:
            continue
        parent[a] = b
        used |= {end} | ({other} if other >= 0 else set())
        chosen.append(i)
    return np.array(chosen, dtype=np.int64)
