"""Hang leaves and fruit on a tree.

Leaf number k is a function of the tree and k alone, so a denser canopy holds every leaf of the
thinner one, and no leaf ever moves a branch.
"""

import numpy as np

from canopy_skel.geometry import FloatArray, IntArray
from mock_hw.orchard.mesh import Kind, Mesh, balls
from mock_hw.orchard.species import LeafShape
from mock_hw.orchard.tree import UP, Tree

_LEAF_STREAM = 1
_FRUIT_STREAM = 2
_DRAWS = 16
_RACHIS_SHARE = 0.6


def triangles_per_leaf(shape: LeafShape) -> int:
    """Return how many triangles one leaf (all its leaflets and its petiole) has."""
    per_blade = len(_blade_faces(len(shape.stations))) * shape.leaflets
    return per_blade + (2 if shape.leaflets == 1 else 4)


def mesh_of_leaves(tree: Tree, count: int, *, kind: Kind = Kind.LEAF) -> Mesh:
    """Return the first `count` leaves, leaf by leaf."""
    shape = tree.species.leaf
    rng = np.random.default_rng([tree.seed, _LEAF_STREAM])
    draws = rng.random((count, _DRAWS))
    first = np.arange(count) // shape.cluster * shape.cluster
    bud, own = draws[first], draws
    vertex = _buds(tree, bud[:, 0])
    base, along, normal = _attachment(tree, vertex, bud, own)
    length = shape.length_m[0] + own[:, 6] * (shape.length_m[1] - shape.length_m[0])
    petiole = shape.petiole_m[0] + own[:, 7] * (shape.petiole_m[1] - shape.petiole_m[0])
    curl = shape.curl[0] + own[:, 8] * (shape.curl[1] - shape.curl[0])
    fold = shape.fold[0] + own[:, 9] * (shape.fold[1] - shape.fold[0])
    make = _simple if shape.leaflets == 1 else _pinnate
    points, normals, texture, faces = make(shape, length, petiole, curl, fold)
    across = np.cross(normal, along)
    frame = np.stack([along, across, normal], axis=1)
    per = points.shape[1]
    triangles = (np.arange(count)[:, None, None] * per + faces).reshape(-1, 3)
    return Mesh(
        points=(base[:, None] + points @ frame).reshape(-1, 3),
        normals=(normals @ frame).reshape(-1, 3).astype(np.float32),
        texture=np.tile(texture, (count, 1)).astype(np.float32),
        anchor=np.repeat(vertex, per).astype(np.int32),
        triangles=triangles.astype(np.int32),
        kind=np.full(len(triangles), kind, dtype=np.uint8),
        vertex=np.full(len(triangles), -1, dtype=np.int32),
        tone=np.repeat(own[:, 10], len(faces)).astype(np.float32),
    )


def mesh_of_fruit(tree: Tree) -> Mesh | None:
    """Return the fruit, hanging under thin wood; None for a species without."""
    shape = tree.species.fruit
    if shape is None:
        return None
    rng = np.random.default_rng([tree.seed, _FRUIT_STREAM])
    thin = (tree.radius_m < 0.006) & (tree.along > 0.3) & (tree.order >= 1)
    vertex = rng.choice(np.flatnonzero(thin), shape.count)
    radius = rng.uniform(*shape.radius_m, shape.count)
    drop = shape.stalk_m + radius * shape.flatness
    sideways = rng.normal(0, 0.3, (shape.count, 3)) * radius[:, None]
    centres = tree.position[vertex] - drop[:, None] * UP + sideways
    return balls(centres, radius, shape.flatness, vertex, rng.random(shape.count))


def _buds(tree: Tree, draw: FloatArray) -> IntArray:
    """Return the skeleton vertex each leaf grows from, by the species' habit."""
    shape = tree.species.leaf
    bearing = np.array(shape.bearing)[np.minimum(tree.order, len(shape.bearing) - 1)]
    weight = bearing * (tree.along + 0.05) ** shape.tip_bias
    weight = weight * (tree.order > 0) + weight * (tree.order == 0) * (tree.along > 0.5)
    cumulative = np.cumsum(weight)
    found = np.searchsorted(cumulative, draw * cumulative[-1])
    return np.asarray(np.minimum(found, len(weight) - 1), dtype=np.int64)


def _attachment(
    tree: Tree, vertex: IntArray, bud: FloatArray, own: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return where each leaf starts, the direction it leaves in and its upper side, all (N, 3)."""
    shape = tree.species.leaf
    direction = tree.directions()[vertex]
    helper = np.where(np.abs(direction[:, 2:]) < 0.9, UP, np.array([1.0, 0.0, 0.0]))
    side = np.cross(direction, helper)
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    other = np.cross(side, direction)
    step = np.arange(len(vertex)) % shape.cluster
    azimuth = 2 * np.pi * (bud[:, 1] + 0.381966 * step) + 0.5 * (own[:, 2] - 0.5)
    radial = np.cos(azimuth)[:, None] * side + np.sin(azimuth)[:, None] * other
    lean = np.radians(40 + 45 * own[:, 3])[:, None]
    along = np.cos(lean) * direction + np.sin(lean) * radial
    along = along + (0.35 * own[:, 4:5] - shape.droop) * UP
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    upper = UP + 0.9 * (own[:, 11:14] - 0.5) + 0.25 * radial
    normal = upper - np.sum(upper * along, axis=1, keepdims=True) * along
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    base = tree.position[vertex] + 0.7 * tree.radius_m[vertex, None] * radial
    base = base + (own[:, 14:15] - 0.5) * 0.012 * direction
    return base, along, normal


def _blade_faces(stations: int) -> IntArray:
    """Return the faces of a blade whose points are midrib, left rim, right rim by station."""
    last = stations - 1
    shared = {stations: 0, stations + last: last, 2 * stations: 0, 2 * stations + last: last}
    faces = []
    for rim in (stations, 2 * stations):
        for i in range(last):
            faces += [(i, i + 1, rim + i + 1), (i, rim + i + 1, rim + i)]
    return np.array([f for f in faces if len({shared.get(corner, corner) for corner in f}) == 3])


def _blade(
    shape: LeafShape, length: FloatArray, curl: FloatArray, fold: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return points (N, P, 3), normals (N, P, 3) and texture (P, 3) of blades along +x."""
    u = np.array(shape.stations)
    w = np.array(shape.half_width)
    x = np.concatenate([u, u, u])
    y = np.concatenate([np.zeros_like(w), w, -w])
    bend = curl[:, None]
    points = np.stack(
        [
            x * (1 - 0.25 * bend * x),
            np.broadcast_to(y * np.cos(fold[:, None]), (len(length), len(x))),
            -0.5 * bend * x**2 + np.abs(y) * np.sin(fold[:, None]),
        ],
        axis=-1,
    )
    slope_x = -bend * x
    slope_y = np.sign(y) * np.tan(fold[:, None])
    normals = np.stack([-slope_x, -slope_y, np.ones_like(slope_x)], axis=-1)
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    texture = np.stack([x, y, np.zeros_like(x)], axis=-1)
    return points * length[:, None, None], normals, texture


def _ribbon(end: FloatArray, width_m: float, pieces: int) -> tuple[FloatArray, FloatArray]:
    """Return points (N, 2·(pieces+1), 3) of a stalk from the origin along +x, and their faces."""
    s = np.linspace(0, 1, pieces + 1)
    half = 0.5 * width_m
    rows = np.zeros((len(end), pieces + 1, 2, 3))
    rows[..., 0] = (end[:, None] * s)[..., None]
    rows[..., 0, 1], rows[..., 1, 1] = half, -half
    faces = []
    for k in range(pieces):
        a = 2 * k
        faces += [(a, a + 1, a + 3), (a, a + 3, a + 2)]
    return rows.reshape(len(end), 2 * pieces + 2, 3), np.array(faces)


Parts = tuple[FloatArray, FloatArray, FloatArray, IntArray]


def _simple(
    shape: LeafShape, length: FloatArray, petiole: FloatArray, curl: FloatArray, fold: FloatArray
) -> Parts:
    """Build leaves with one blade on a petiole."""
    blade, normals, texture = _blade(shape, length, curl, fold)
    blade[..., 0] += petiole[:, None]
    return _with_stalk([blade], [normals], texture, shape, petiole, 0.0016, 1)


def _pinnate(
    shape: LeafShape, length: FloatArray, petiole: FloatArray, curl: FloatArray, fold: FloatArray
) -> Parts:
    """Build compound leaves: pairs of leaflets along a rachis and one at its end."""
    rachis = petiole + _RACHIS_SHARE * length
    blades, sides = [], []
    for k in range(shape.leaflets):
        place, size, angle = _leaflet(k, shape.leaflets)
        blade, normals, texture = _blade(shape, size * length, curl, fold)
        c, s = np.cos(angle), np.sin(angle)
        turn = np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])
        blade = blade @ turn
        blade[..., 0] += (place * rachis)[:, None]
        blades.append(blade)
        sides.append(normals @ turn)
    parts = _with_stalk(blades, sides, texture, shape, rachis, 0.0026, 2)
    sag = parts[0][..., 0] ** 2 * (0.9 * curl / length)[:, None]
    parts[0][..., 2] -= sag
    return parts


def _leaflet(number: int, leaflets: int) -> tuple[float, float, float]:
    """Return a leaflet's place on the rachis, its size per leaf length and its angle.

    Leaflets stand in pairs that grow and lean forward towards the tip; the last ends the leaf.
    """
    if number == leaflets - 1:
        return 1.0, 0.4, 0.0
    pair = number // 2
    up = pair / max((leaflets - 1) // 2 - 1, 1)
    side = 1 if number % 2 == 0 else -1
    return 0.3 + 0.62 * up, 0.24 + 0.1 * up, side * float(np.radians(62 - 8 * pair))


def _with_stalk(
    blades: list[FloatArray],
    normals: list[FloatArray],
    texture: FloatArray,
    shape: LeafShape,
    stalk: FloatArray,
    width_m: float,
    pieces: int,
) -> Parts:
    """Join blades and the stalk into one leaf; texture z = 1 marks the stalk."""
    faces = _blade_faces(len(shape.stations))
    per = blades[0].shape[1]
    ribbon, ribbon_faces = _ribbon(stalk, width_m, pieces)
    points = np.concatenate([*blades, ribbon], axis=1)
    upright = np.zeros_like(ribbon)
    upright[..., 2] = 1.0
    marks = np.zeros((ribbon.shape[1], 3))
    marks[:, 2] = 1.0
    all_faces = [faces + k * per for k in range(len(blades))] + [ribbon_faces + len(blades) * per]
    return (
        points,
        np.concatenate([*normals, upright], axis=1),
        np.concatenate([*([texture] * len(blades)), marks]),
        np.concatenate(all_faces),
    )
