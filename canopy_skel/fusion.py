"""Points seen in many views -> one thin forest of observed wood (mode `canopy`)."""

from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import minimum_spanning_tree
from scipy.spatial import cKDTree

from canopy_skel.geometry import BoolArray, FloatArray, IntArray
from canopy_skel.initial import prune_spurs
from canopy_skel.kernels import fuse as kernel

_BITS = 62
"""Views are counted by bits of one number: of more than these some count as one."""


@dataclass(frozen=True, kw_only=True, slots=True)
class FusionConfig:
    """How points become curves.

    `steps` of a mean shift across the local direction, against the points as observed: Gaussian
    weights of max(`bandwidth_m`, `radius_share` x radius), neighbours within `max_angle_deg`,
    fragments counting `fragment_weight`. Directions of fragments are first turned along the points
    around them, with Gaussian weights of `turn_m`; `own_direction` is the weight of their own, as a
    share of its square. Vertices are kept `spacing_m` apart, the best supported
    first, and joined up to `reach_m`. Dead ends up to `spur_m` at a fork are noise. Rows of
    vertices that fragments show, whose own places are poor, are smoothed in `smooth_steps`, and
    turned towards their directions, tips included, in `align_steps`.
    """

    steps: int = 3
    bandwidth_m: float = 0.012
    radius_share: float = 0.5
    max_angle_deg: float = 60.0
    fragment_weight: float = 0.5
    turn_m: float = 0.02
    own_direction: float = 0.075
    seed_m: float = 0.004
    spacing_m: float = 0.006
    reach_m: float = 0.017
    spur_m: float = 0.02
    smooth_steps: int = 8
    align_steps: int = 8


@dataclass(frozen=True, kw_only=True, eq=False, slots=True)
class Observations:
    """Points on observed wood, in canonical order.

    points_in_base, directions: (N, 3), unit. radius_m, of the pixels, probable_radius_m, what the
    wood has, probability (to be wood): (N,). view: (N,), its place among those that are in.
    fragment: (N,), a fragment showed it and not an instance.
    """

    points_in_base: FloatArray
    directions: FloatArray
    radius_m: FloatArray
    probable_radius_m: FloatArray
    probability: FloatArray
    view: IntArray
    fragment: BoolArray

    def chosen(self, stay: BoolArray) -> "Observations":
        """Return the points (N,) that stay."""
        return Observations(
            points_in_base=self.points_in_base[stay],
            directions=self.directions[stay],
            radius_m=self.radius_m[stay],
            probable_radius_m=self.probable_radius_m[stay],
            probability=self.probability[stay],
            view=self.view[stay],
            fragment=self.fragment[stay],
        )


@dataclass(frozen=True, kw_only=True, eq=False, slots=True)
class Observed:
    """The observed forest: vertices (V, 3), directions (V, 3), support (V, 7), edges (E, 2).

    support: total weight, radius, mean and largest probability, views, share from instances,
    probable radius.
    """

    vertices_in_base: FloatArray
    directions: FloatArray
    support: FloatArray
    edges: IntArray


def fuse(seen: Observations, config: FusionConfig) -> Observed:
    """Draw the points onto curves, thin them and span them by a forest.

    The points must come in canonical order; nothing else decides ties.
    """
    if len(seen.points_in_base) == 0:
        return _nothing()
    seen = turned(seen, config)
    points, directions, support = _drawn(seen, config)
    kept = _thinned(points, support[:, 0], config.spacing_m)
    points, directions, support = points[kept], directions[kept], support[kept]
    edges = forest(points, directions, config.reach_m)
    stay, edges = prune_spurs(points, edges, config.spur_m)
    points, directions, support = points[stay], directions[stay], support[stay]
    poor = support[:, 5] < 0.5
    points = _smoothed(points, edges, poor, config.smooth_steps)
    return Observed(
        vertices_in_base=_aligned(points, directions, edges, poor, config.align_steps),
        directions=directions,
        support=support,
        edges=edges,
    )


def _drawn(seen: Observations, config: FusionConfig) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return seeds (S, 3) drawn onto the curves, their directions and support, in canonical order.

    They are worked on cell by cell: neighbours share most of what is around them.
    """
    cell_m = 2 * config.bandwidth_m
    keys = kernel.cell_keys(seen.points_in_base, cell_m)
    order = np.argsort(keys, kind="stable")
    weight = seen.probability * np.where(seen.fragment, config.fragment_weight, 1.0)
    seeds = heaviest(seen.points_in_base, weight, config.seed_m)
    by_cell = np.argsort(keys[seeds], kind="stable")
    seeds = seeds[by_cell]
    references = (
        seen.points_in_base[order],
        seen.directions[order],
        seen.radius_m[order],
        seen.probable_radius_m[order],
        weight[order],
        seen.probability[order],
        np.left_shift(1, seen.view[order] % _BITS),
        seen.fragment[order],
        keys[order],
    )
    points, directions = seen.points_in_base[seeds], seen.directions[seeds]
    radius_m, support = seen.radius_m[seeds], np.zeros((len(seeds), kernel.SUPPORT))
    for _ in range(config.steps + 1):
        points, directions, support = kernel.shift_across(
            points,
            directions,
            radius_m,
            *references,
            cell_m,
            config.bandwidth_m,
            config.radius_share,
            np.cos(np.radians(config.max_angle_deg)),
        )
        radius_m = support[:, 1].copy()
    place = np.empty_like(by_cell)
    place[by_cell] = np.arange(len(by_cell))
    return points[place], directions[place], support[place]


def turned(seen: Observations, config: FusionConfig) -> Observations:
    """Turn the points of fragments along what lies around them in all views.

    A fragment of 15 pixels does not show its own direction; many of them do.
    """
    if not seen.fragment.any():
        return seen
    keys = kernel.cell_keys(seen.points_in_base, config.turn_m)
    order = np.argsort(keys, kind="stable")
    chosen = np.flatnonzero(seen.fragment[order])
    spread = kernel.spread_around(
        chosen,
        seen.directions[order],
        seen.points_in_base[order],
        seen.probability[order],
        keys[order],
        config.turn_m,
        config.turn_m,
        config.own_direction,
    )
    directions = seen.directions.copy()
    directions[order[chosen]] = np.linalg.eigh(spread)[1][:, :, 2]
    return replace(seen, directions=directions)


def forest(points: FloatArray, directions: FloatArray, reach_m: float) -> IntArray:
    """Return the minimum spanning forest (E, 2) over pairs within reach.

    A pair is the dearer the less its directions agree, and the less it runs along either: a side
    branch is to meet its parent in its own direction, not by the shortest way.
    """
    if len(points) < 2:
        return np.zeros((0, 2), dtype=np.int64)
    pairs = cKDTree(points).query_pairs(reach_m, output_type="ndarray").astype(np.int64)
    pairs = pairs[np.lexsort((pairs[:, 1], pairs[:, 0]))]
    a, b = pairs.T
    way = points[b] - points[a]
    length = np.linalg.norm(way, axis=1)
    along = way / np.maximum(length, 1e-12)[:, None]
    turns = (
        _turn(directions[a], directions[b])
        + _turn(directions[a], along)
        + _turn(directions[b], along)
    )
    weights = np.maximum(length * (1.0 + turns), 1e-12)
    tree = minimum_spanning_tree(
        coo_array((weights, pairs.T), shape=(len(points),) * 2).tocsr()
    ).tocoo()
    return np.stack([tree.row, tree.col], axis=1).astype(np.int64)


def _turn(one: FloatArray, other: FloatArray) -> FloatArray:
    """Return 0 for parallel unit vectors (N, 3), up to 1 across."""
    cosine: FloatArray = np.abs(np.sum(one * other, axis=1))
    return 1.0 - cosine


def _smoothed(points: FloatArray, edges: IntArray, chosen: BoolArray, steps: int) -> FloatArray:
    """Move the chosen points (V,) with two neighbours halfway to the middle of these."""
    n = len(points)
    both = np.concatenate([edges, edges[:, ::-1]])
    adjacency = coo_array((np.ones(len(both)), both.T), shape=(n, n)).tocsr()
    free = chosen & (np.bincount(edges.ravel(), minlength=n) == 2)
    for _ in range(steps):
        middle = 0.5 * (adjacency @ points)
        points = np.where(free[:, None], 0.5 * (points + middle), points)
    return points


def _aligned(
    points: FloatArray, directions: FloatArray, edges: IntArray, chosen: BoolArray, steps: int
) -> FloatArray:
    """Move the chosen points (V,) at no fork so that edges run as the directions of their ends."""
    n = len(points)
    a, b = edges.T
    neighbours = np.bincount(edges.ravel(), minlength=n)
    free = chosen & (neighbours > 0) & (neighbours < 3)
    sign = np.where(np.sum(directions[a] * directions[b], axis=1) < 0, -1.0, 1.0)
    along = directions[a] + sign[:, None] * directions[b]
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    for _ in range(steps):
        way = points[b] - points[a]
        across = way - np.sum(way * along, axis=1, keepdims=True) * along
        pulled = [np.bincount(a, c, n) - np.bincount(b, c, n) for c in across.T]
        moved = points + 0.25 * np.stack(pulled, axis=1) / np.maximum(neighbours, 1)[:, None]
        points = np.where(free[:, None], moved, points)
    return points


def heaviest(points: FloatArray, weight: FloatArray, cell_m: float) -> IntArray:
    """Return the heaviest point of each cell that holds any, in the order of the points."""
    of = kernel.cell_keys(points, cell_m)
    order = np.lexsort((np.arange(len(of)), -weight, of))
    first = np.ones(len(of), dtype=np.bool_)
    first[1:] = np.diff(of[order]) > 0
    return np.sort(order[first])


def _thinned(points: FloatArray, density: FloatArray, spacing_m: float) -> IntArray:
    keys = kernel.cell_keys(points, spacing_m)
    by_cell = np.argsort(keys, kind="stable")
    points, density = points[by_cell], density[by_cell]
    order = np.lexsort((*points.T[::-1], -density))
    kept = kernel.thinned(points, order, keys[by_cell], spacing_m, spacing_m)
    return np.sort(by_cell[kept])


def _nothing() -> Observed:
    return Observed(
        vertices_in_base=np.zeros((0, 3)),
        directions=np.zeros((0, 3)),
        support=np.zeros((0, kernel.SUPPORT)),
        edges=np.zeros((0, 2), dtype=np.int64),
    )
