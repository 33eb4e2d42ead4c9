"""A scene: one labelled tree with its foliage and surroundings, ready to be drawn from anywhere."""

from dataclasses import dataclass

import numpy as np

from canopy_skel.frame import Float32Array
from canopy_skel.geometry import FloatArray, IntArray
from mock_hw.orchard.instances import pieces_of
from mock_hw.orchard.kernels import raster, texture
from mock_hw.orchard.leaves import mesh_of_fruit, mesh_of_leaves
from mock_hw.orchard.light import Light
from mock_hw.orchard.mesh import Mesh, merged, mesh_of_wood
from mock_hw.orchard.species import Species
from mock_hw.orchard.surroundings import mesh_of_rows, mesh_of_trellis
from mock_hw.orchard.tree import GROUND_Z_M, TRUNK_X_M, Tree

_SUN_MAP_PX = 1536
_SHADOW_MAP_M = 2.6
_ZENITH_MAP_PX = 320
_ROW_LEAVES = {"apple": (300, 1400), "oak": (150, 1500), "walnut": (100, 260)}


@dataclass(frozen=True, kw_only=True, eq=False, slots=True)
class ShadowMap:
    """A parallel view of the tree. map_from_base: (3, 4) to u, v, w; w: (H, W) nearest w."""

    map_from_base: FloatArray
    w: FloatArray


@dataclass(frozen=True, kw_only=True, eq=False, slots=True)
class Scene:
    """Everything a picture depends on but the camera.

    piece: (V,) the piece of straight wood each skeleton vertex belongs to. radius_m: (T,) of the
    wood a triangle shows.
    """

    tree: Tree
    leaf_count: int
    mesh: Mesh
    piece: IntArray
    radius_m: Float32Array
    light: Light
    palette: FloatArray
    sun_map: ShadowMap
    zenith_map: ShadowMap


def fixtures(tree: Tree, seed: int, *, trellis: bool) -> list[Mesh]:
    """Return what hides wood beside the leaves: wood, fruit, posts and wires."""
    rng = np.random.default_rng([seed, 3])
    parts = [mesh_of_wood(tree)]
    fruit = mesh_of_fruit(tree)
    if fruit is not None:
        parts.append(fruit)
    if trellis:
        parts.append(mesh_of_trellis(rng))
    return parts


def build_scene(
    tree: Tree, leaf_count: int, light: Light, *, seed: int, rows: bool = True, trellis: bool = True
) -> Scene:
    """Put a tree with `leaf_count` leaves into its surroundings."""
    parts = fixtures(tree, seed, trellis=trellis)
    if rows:
        leaves = int(np.clip(leaf_count, *_ROW_LEAVES[tree.species.name]))
        parts.append(mesh_of_rows(tree.species, leaves, np.random.default_rng([seed, 7])))
    mesh = merged([*parts, mesh_of_leaves(tree, leaf_count)])
    radius = np.where(mesh.vertex >= 0, tree.radius_m[mesh.vertex], 0.012).astype(np.float32)
    return Scene(
        tree=tree,
        leaf_count=leaf_count,
        mesh=mesh,
        piece=pieces_of(tree),
        radius_m=radius,
        light=light,
        palette=_palette(tree.species, light),
        sun_map=_shadow_map(mesh, light.sun_direction(), _SUN_MAP_PX),
        zenith_map=_shadow_map(mesh, np.array([0.0, 0.0, 1.0]), _ZENITH_MAP_PX),
    )


def _palette(species: Species, light: Light) -> FloatArray:
    """Return the (15, 3) linear colours in the order of `kernels.texture`."""
    colours = species.colours
    palette = np.zeros((15, 3))
    palette[texture.BARK], palette[texture.SHOOT] = colours.bark, colours.shoot
    palette[texture.ABOVE], palette[texture.BELOW] = colours.leaf_above, colours.leaf_below
    palette[texture.THROUGH] = colours.leaf_through
    palette[texture.FRUIT], palette[texture.CHEEK] = colours.fruit, colours.fruit_cheek
    palette[texture.POST], palette[texture.WIRE] = (0.26, 0.23, 0.19), (0.30, 0.30, 0.31)
    palette[texture.GRASS], palette[texture.SOIL] = (0.075, 0.125, 0.03), (0.15, 0.11, 0.075)
    palette[texture.SUN], palette[texture.SKY] = light.sun, light.sky
    palette[texture.HORIZON] = light.horizon
    palette[texture.HEDGE] = (0.05, 0.08, 0.035)
    return palette


def _shadow_map(mesh: Mesh, towards_light: FloatArray, size_px: int) -> ShadowMap:
    """Draw the tree as the light sees it."""
    centre = np.array([TRUNK_X_M, 0.0, GROUND_Z_M + 0.95])
    if towards_light[2] > 0.999:
        right, down = np.array([1.0, 0.0, 0.0]), np.array([0.0, 1.0, 0.0])
    else:
        right = np.cross([0.0, 0.0, 1.0], towards_light)
        right /= np.linalg.norm(right)
        down = np.cross(right, towards_light)
    scale = size_px / _SHADOW_MAP_M
    axes = np.stack([right * scale, down * scale, towards_light])
    offset = np.array([size_px / 2, size_px / 2, 10.0]) - axes @ centre
    map_from_base = np.concatenate([axes, offset[:, None]], axis=1)
    screen = mesh.points @ axes.T + offset
    w = np.zeros((size_px, size_px))
    raster.draw(screen, mesh.triangles, w, np.empty(w.shape, dtype=np.int32))
    return ShadowMap(map_from_base=map_from_base, w=w)
