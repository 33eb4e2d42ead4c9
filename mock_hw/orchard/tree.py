"""Grow the wood of a tree: a skeleton graph with radii, in the robot's base frame.

Each branch draws from a random stream of its own (`SeedSequence.spawn`), so a change to one
branch, or to the foliage, moves no other branch. After Weber & Penn (1995), simplified: curvature
is a random turn at each node plus a steady turn towards the sky.
"""

from collections import deque
from dataclasses import dataclass

import numpy as np

from canopy_skel.geometry import FloatArray, IntArray
from mock_hw.orchard.species import Growth, Species

SPACING_M = 0.008
TRUNK_X_M = 1.70
GROUND_Z_M = -0.95
TOP_Z_M = 0.87
CLEARANCE_M = 0.42
HEDGE_M = 0.75
_SHORTEST = 6
_LIFT = 4.0
UP = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True, kw_only=True, eq=False, slots=True)
class TreeBranch:
    """One branch: `vertices` start with the parent's vertex it grows from (not so the trunk)."""

    id: int
    parent: int | None
    order: int
    vertices: IntArray


@dataclass(frozen=True, kw_only=True, eq=False, slots=True)
class Tree:
    """The true skeleton. Vertex 0 is the foot of the trunk.

    position: (V, 3) in base, metres. radius_m: (V,). branch, order: (V,) of the branch a vertex
    belongs to. parent: (V,) the vertex below, -1 at the foot. along: (V,) 0 at the base of the
    branch, 1 at its tip.
    """

    species: Species
    seed: int
    position: FloatArray
    radius_m: FloatArray
    branch: IntArray
    order: IntArray
    parent: IntArray
    along: FloatArray
    branches: tuple[TreeBranch, ...]

    def edges(self) -> IntArray:
        """Return (E, 2) edges, each from the vertex below."""
        child = np.flatnonzero(self.parent >= 0)
        return np.stack([self.parent[child], child], axis=1)

    def directions(self) -> FloatArray:
        """Return (V, 3) unit directions of growth at each vertex."""
        below = np.where(self.parent >= 0, self.parent, 0)
        direction = self.position - self.position[below]
        direction[0] = self.position[1] - self.position[0]
        return np.asarray(direction / np.linalg.norm(direction, axis=1, keepdims=True))


@dataclass(frozen=True, kw_only=True, eq=False, slots=True)
class _Bud:
    """A branch about to grow."""

    stream: np.random.SeedSequence
    parent: int | None
    order: int
    vertex: int
    start: FloatArray
    heading: FloatArray
    length_m: float
    radius_m: float


def grow(species: Species, seed: int) -> Tree:
    """Grow one tree; the same seed gives the same wood, whatever hangs on it later."""
    stream = np.random.SeedSequence([seed, *species.name.encode()])
    buds = deque([_trunk_bud(species, stream)])
    parts: list[tuple[FloatArray, FloatArray, FloatArray]] = []
    branches: list[TreeBranch] = []
    parents: list[IntArray] = []
    size = 0
    while buds:
        bud = buds.popleft()
        shape_stream, bud_stream = bud.stream.spawn(2)
        line = _centreline(species.orders[bud.order], bud, np.random.default_rng(shape_stream))
        if len(line) < _SHORTEST:
            continue
        along = np.linspace(0.0, 1.0, len(line))
        radius = _radii(species, bud, along)
        own = np.arange(size, size + len(line))
        vertices = own if bud.parent is None else np.concatenate([[bud.vertex], own])
        branch = TreeBranch(id=len(branches), parent=bud.parent, order=bud.order, vertices=vertices)
        branches.append(branch)
        parents.append(np.concatenate([[bud.vertex], own[:-1]]))
        parts.append((line, radius, along))
        size += len(line)
        if bud.order + 1 < len(species.orders):
            buds.extend(_side_buds(species, branch, line, radius, bud_stream))
    lengths = [len(line) for line, _, _ in parts]
    return Tree(
        species=species,
        seed=seed,
        position=np.concatenate([line for line, _, _ in parts]),
        radius_m=np.concatenate([radius for _, radius, _ in parts]),
        branch=np.repeat([b.id for b in branches], lengths),
        order=np.repeat([b.order for b in branches], lengths),
        parent=np.concatenate(parents),
        along=np.concatenate([along for _, _, along in parts]),
        branches=tuple(branches),
    )


def _trunk_bud(species: Species, stream: np.random.SeedSequence) -> _Bud:
    own, rest = stream.spawn(2)
    rng = np.random.default_rng(own)
    growth = species.orders[0]
    azimuth, lean = rng.uniform(0, 2 * np.pi), np.radians(rng.uniform(0, species.lean_deg))
    heading = np.array(
        [np.sin(lean) * np.cos(azimuth), np.sin(lean) * np.sin(azimuth), np.cos(lean)]
    )
    return _Bud(
        stream=rest,
        parent=None,
        order=0,
        vertex=-1,
        start=np.array([TRUNK_X_M, 0.0, GROUND_Z_M]),
        heading=heading,
        length_m=growth.length_m[0] * (1 + growth.length_spread * rng.standard_normal()),
        radius_m=rng.uniform(*species.trunk_radius_m),
    )


def _centreline(growth: Growth, bud: _Bud, rng: np.random.Generator) -> FloatArray:
    """Return the (N, 3) points of a branch, `SPACING_M` apart.

    Wood that would reach above the top or into the alleys on either side is pruned.
    """
    steps = max(round(bud.length_m / SPACING_M), 1)
    kinks = _kinks(growth, steps, rng)
    point, heading = bud.start, bud.heading
    points = [point] if bud.parent is None else []
    for step in range(steps):
        pull = growth.rise * UP + growth.hold * bud.heading
        if point[2] < GROUND_Z_M + CLEARANCE_M and bud.parent is not None:
            pull = pull + _LIFT * UP
        heading = heading + SPACING_M * (pull - (pull @ heading) * heading)
        heading = heading + kinks[step] - (kinks[step] @ heading) * heading
        heading = heading / np.linalg.norm(heading)
        point = point + SPACING_M * heading
        if point[2] > TOP_Z_M or abs(point[0] - TRUNK_X_M) > HEDGE_M:
            break
        points.append(point)
    return np.array(points).reshape(-1, 3)


def _kinks(growth: Growth, steps: int, rng: np.random.Generator) -> FloatArray:
    """Return (steps, 3) turns: one random turn per node, spread over three steps."""
    nodes = np.cumsum(rng.uniform(0.6, 1.4, steps + 1) * growth.node_m)
    at = (nodes / SPACING_M).astype(np.int64)
    turns = rng.standard_normal((steps + 1, 3)) * np.radians(growth.crook_deg)
    kinks = np.zeros((steps + 3, 3))
    for offset in range(3):
        np.add.at(kinks, np.minimum(at + offset, steps + 2), turns / 3)
    return kinks[:steps]


def _radii(species: Species, bud: _Bud, along: FloatArray) -> FloatArray:
    """Taper from the base to the tip; the foot of the trunk is flared."""
    tip = species.tip_radius_m if not (species.forked and bud.order == 0) else 0.6 * bud.radius_m
    taper = species.orders[bud.order].taper
    radius = tip + (bud.radius_m - tip) * (1 - along) ** taper
    if bud.order == 0:
        radius = radius * (1 + 0.35 * np.exp(-along * bud.length_m / 0.05))
    return np.asarray(radius)


def _side_buds(
    species: Species,
    branch: TreeBranch,
    line: FloatArray,
    radius: FloatArray,
    stream: np.random.SeedSequence,
) -> list[_Bud]:
    """Set the buds of the next order along one branch."""
    growth = species.orders[branch.order + 1]
    own, rest = stream.spawn(2)
    rng = np.random.default_rng(own)
    low, high = growth.span
    span_m = (high - low) * len(line) * SPACING_M
    count = int(growth.per_metre * span_m + rng.uniform())
    places = (np.arange(count) + rng.uniform(0.2, 0.8, count)) / max(count, 1)
    if species.forked and branch.order == 0 and count:
        places[-1] = 1.0
    azimuth = rng.uniform(0, 360) + np.cumsum(growth.whorl_deg + rng.normal(0, 18.0, count))
    spread = rng.standard_normal((count, 2))
    own_vertices = branch.vertices if branch.parent is None else branch.vertices[1:]
    buds = []
    for place, turn, (more, wider), child in zip(
        places, azimuth, spread, rest.spawn(count), strict=True
    ):
        k = min(int((low + place * (high - low)) * (len(line) - 1)), len(line) - 1)
        stops = (0.0, 0.5, 1.0)
        length = np.interp(place, stops, growth.length_m) * np.exp(growth.length_spread * more)
        angle = np.interp(place, stops, growth.angle_deg) + growth.angle_spread_deg * wider
        heading = line[k] - line[k - 1] if k else line[1] - line[0]
        buds.append(
            _Bud(
                stream=child,
                parent=branch.id,
                order=branch.order + 1,
                vertex=int(own_vertices[k]),
                start=line[k],
                heading=_turned(heading / np.linalg.norm(heading), angle, turn),
                length_m=float(length),
                radius_m=_base_radius(species, growth, float(length), float(radius[k])),
            )
        )
    return buds


def _base_radius(
    species: Species, growth: Growth, length_m: float, parent_radius_m: float
) -> float:
    wanted = species.tip_radius_m + growth.stoutness * length_m
    return max(min(wanted, growth.radius_share * parent_radius_m), species.tip_radius_m)


def _turned(direction: FloatArray, angle_deg: float, azimuth_deg: float) -> FloatArray:
    """Lean a unit direction by an angle, towards an azimuth counted from the horizontal side."""
    side = np.cross(direction, UP if abs(direction[2]) < 0.95 else np.array([1.0, 0.0, 0.0]))
    side = side / np.linalg.norm(side)
    other = np.cross(direction, side)
    azimuth, angle = np.radians(azimuth_deg), np.radians(angle_deg)
    radial = np.cos(azimuth) * side + np.sin(azimuth) * other
    return np.asarray(np.cos(angle) * direction + np.sin(angle) * radial)
