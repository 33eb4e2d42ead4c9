import numpy as np
import pytest

from mock_hw.orchard.leaves import mesh_of_fruit, mesh_of_leaves, triangles_per_leaf
from mock_hw.orchard.light import fair_weather
from mock_hw.orchard.mesh import Kind, mesh_of_wood
from mock_hw.orchard.presets import SPECIES
from mock_hw.orchard.scene import build_scene
from mock_hw.orchard.tree import SPACING_M, grow


def test_each_face_of_a_branch_carries_the_nearest_skeleton_vertex(apple):
    mesh = mesh_of_wood(apple)
    centre = mesh.points[mesh.triangles].mean(axis=1)
    off = centre - apple.position[mesh.vertex]
    along = np.abs(np.sum(off * apple.directions()[mesh.vertex], axis=1))
    assert np.quantile(along, 0.99) < 0.5 * SPACING_M
    across = np.linalg.norm(off, axis=1)
    assert (across < 1.25 * apple.radius_m[mesh.vertex] + SPACING_M).all()
    assert set(mesh.vertex) == set(range(len(apple.position)))


def test_tubes_are_as_thick_as_the_skeleton_says(apple):
    mesh = mesh_of_wood(apple)
    trunk = apple.branches[0].vertices
    ring = mesh.points[mesh.triangles[mesh.vertex == trunk[40]].ravel()]
    radius = np.linalg.norm((ring - apple.position[trunk[40]])[:, :2], axis=1)
    assert radius.mean() == pytest.approx(apple.radius_m[trunk[40]], rel=0.05)


@pytest.mark.parametrize("name", sorted(SPECIES))
def test_more_leaves_keep_every_earlier_leaf_and_never_move_a_branch(name):
    tree = grow(SPECIES[name], 1)
    few, many = (
        build_scene(tree, n, fair_weather(), seed=0, rows=False, trellis=False) for n in (23, 60)
    )
    wood = few.mesh.kind == Kind.WOOD
    points = few.mesh.triangles[wood].max() + 1
    assert few.mesh.points[:points].tobytes() == many.mesh.points[:points].tobytes()
    first, second = mesh_of_leaves(tree, 23), mesh_of_leaves(tree, 60)
    assert first.points.tobytes() == second.points[: len(first.points)].tobytes()
    per = triangles_per_leaf(tree.species.leaf)
    assert len(first.triangles) == 23 * per
    assert np.array_equal(first.triangles, second.triangles[: 23 * per])


@pytest.mark.parametrize("name", sorted(SPECIES))
def test_leaves_have_the_size_of_the_species_and_hang_on_its_wood(name):
    tree = grow(SPECIES[name], 1)
    mesh = mesh_of_leaves(tree, 200)
    leaf = tree.species.leaf
    reach = leaf.length_m[1] + leaf.petiole_m[1] + 0.03
    distance = np.linalg.norm(mesh.points - tree.position[mesh.anchor], axis=1)
    assert distance.max() < 1.05 * reach
    corners = mesh.points[mesh.triangles]
    area = np.linalg.norm(
        np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1
    )
    assert area.min() > 0
    assert np.isfinite(mesh.normals).all()
    assert set(mesh.vertex) == {-1}
    assert (tree.order[mesh.anchor] == 1).any(), "some leaves sit on scaffold wood"


def test_a_bare_tree_has_no_leaves_and_an_oak_no_fruit():
    assert len(mesh_of_leaves(grow(SPECIES["apple"], 0), 0).triangles) == 0
    assert mesh_of_fruit(grow(SPECIES["oak"], 0)) is None


def test_apples_hang_below_thin_wood(apple):
    fruit = mesh_of_fruit(apple)
    assert fruit is not None
    twig = apple.position[fruit.anchor]
    assert (
        fruit.points[:, 2].reshape(apple.species.fruit.count, -1).mean(axis=1)
        < twig[:, 2].reshape(apple.species.fruit.count, -1)[:, 0]
    ).all()
