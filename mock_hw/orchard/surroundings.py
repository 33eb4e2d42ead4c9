"""What stands around the tree: rows behind it, posts and wires. None of it is labelled."""

from dataclasses import replace

import numpy as np

from canopy_skel.geometry import FloatArray
from mock_hw.orchard.leaves import mesh_of_leaves
from mock_hw.orchard.mesh import Kind, Mesh, merged, mesh_of_wood, straight_tube
from mock_hw.orchard.species import Species
from mock_hw.orchard.tree import GROUND_Z_M, TRUNK_X_M, grow

ROW_PITCH_M = 2.9
_TREE_PITCH_M = 1.7
_MODELS = 3
_TREES_BY_ROW = (5, 9)


def mesh_of_rows(species: Species, leaves_per_tree: int, rng: np.random.Generator) -> Mesh:
    """Return the next two rows: a few models, turned and set out along the rows."""
    models = [_model(species, leaves_per_tree, int(rng.integers(1 << 31))) for _ in range(_MODELS)]
    trees = []
    for row, count in enumerate(_TREES_BY_ROW, start=1):
        shift = rng.uniform(-0.5, 0.5)
        for k in range(count):
            y = (k - (count - 1) / 2 + shift) * _TREE_PITCH_M + rng.normal(0, 0.1)
            turn = rng.uniform(0, 2 * np.pi)
            place = np.array([row * ROW_PITCH_M + rng.normal(0, 0.05), y, 0.0])
            trees.append(_turned(models[int(rng.integers(_MODELS))], turn, place))
    return merged(trees)


def _model(species: Species, leaves: int, seed: int) -> Mesh:
    tree = grow(species, seed)
    wood = mesh_of_wood(tree)
    wood = replace(
        wood,
        kind=np.full_like(wood.kind, Kind.FAR_WOOD),
        vertex=np.full_like(wood.vertex, -1),
    )
    mesh = merged([wood, mesh_of_leaves(tree, leaves, kind=Kind.FAR_LEAF)])
    return replace(mesh, anchor=np.full_like(mesh.anchor, -1))


def _turned(mesh: Mesh, turn: float, offset: FloatArray) -> Mesh:
    """Turn a tree about its trunk and move it."""
    c, s = np.cos(turn), np.sin(turn)
    rotation = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    trunk = np.array([TRUNK_X_M, 0.0, 0.0])
    points = (mesh.points - trunk) @ rotation.T + trunk + offset
    return replace(mesh, points=points, normals=(mesh.normals @ rotation.T).astype(np.float32))


def mesh_of_trellis(rng: np.random.Generator) -> Mesh:
    """Return three wires along the row of the tree, and a post on either side of it."""
    parts = []
    for height in (0.55, 1.05, 1.55):
        z, x = GROUND_Z_M + height, TRUNK_X_M + rng.choice([-1, 1]) * rng.uniform(0.035, 0.05)
        ends = np.array([[x, -5.0, z], [x, 5.0, z]])
        parts.append(straight_tube(ends[0], ends[1], 0.0015, Kind.WIRE, piece_m=0.25))
    for side in (-1.0, 1.0):
        foot = np.array([TRUNK_X_M + 0.02, side * rng.uniform(1.0, 1.7), GROUND_Z_M])
        top = foot + np.array([rng.normal(0, 0.02), rng.normal(0, 0.02), 1.95])
        parts.append(straight_tube(foot, top, rng.uniform(0.03, 0.045), Kind.POST, piece_m=0.5))
    return merged(parts)
