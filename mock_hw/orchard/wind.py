"""Bend a tree in the wind: thin wood far from the trunk moves most, leaves flutter with it."""

from dataclasses import replace

import numpy as np

from canopy_skel.geometry import FloatArray
from mock_hw.orchard.mesh import Kind, Mesh
from mock_hw.orchard.tree import SPACING_M, Tree


def compliance(tree: Tree) -> FloatArray:
    """Return (V,) how far each vertex gives way, 0 at the foot, 1 at the tip that moves most."""
    bend = SPACING_M / (tree.radius_m + 0.004) ** 1.5
    give = np.zeros(len(bend))
    for vertex, below in enumerate(tree.parent):
        if below >= 0:
            give[vertex] = give[below] + bend[vertex]
    give = give**1.5
    return np.asarray(give / give.max())


def swayed(mesh: Mesh, tree: Tree, reach_m: float, rng: np.random.Generator) -> Mesh:
    """Return the mesh at one moment of a wind that moves the loosest tip by about `reach_m`.

    Each branch swings in the common direction of the gust and a little on its own; labels and
    texture coordinates stay.
    """
    gust = np.append(rng.standard_normal(2), 0.2 * rng.standard_normal())
    own = rng.standard_normal((len(tree.branches), 3)) * [0.4, 0.4, 0.3]
    give = compliance(tree)
    swing = np.zeros_like(tree.position)
    for branch in tree.branches[1:]:
        inside, foot = branch.vertices[1:], branch.vertices[0]
        swing[inside] = swing[foot] + (give[inside] - give[foot])[:, None] * own[branch.id]
    shift = reach_m * (give[:, None] * gust + swing)
    held = mesh.anchor >= 0
    moved = mesh.points.copy()
    moved[held] += shift[mesh.anchor[held]]
    flutter = np.zeros(len(moved), dtype=bool)
    flutter[mesh.triangles[mesh.kind == Kind.LEAF].ravel()] = True
    blade = np.linalg.norm(mesh.points - tree.position[mesh.anchor], axis=1)
    beat = np.sin(1.7 * mesh.anchor + rng.uniform(0, 2 * np.pi))
    moved[flutter, 2] += (0.25 * reach_m * beat * np.minimum(blade / 0.08, 1.5))[flutter]
    return replace(mesh, points=moved)
