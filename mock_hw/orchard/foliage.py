"""How many leaves make a foliage density: as many as leave V_det of the tree detectable.

V_det is the share of the true skeleton (of what any view frames) that lies in some fragment large
enough to be found in one image; see `instances`. Seen "by two pixels" would saturate.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from canopy_skel.errors import UsageError
from canopy_skel.frame import Intrinsics
from canopy_skel.geometry import BoolArray, FloatArray, IntArray, invert, transform_points
from mock_hw.orchard import renderer
from mock_hw.orchard.instances import fragments_of, pieces_of
from mock_hw.orchard.kernels import raster
from mock_hw.orchard.leaves import mesh_of_leaves, triangles_per_leaf
from mock_hw.orchard.mesh import Int32Array, merged
from mock_hw.orchard.path import OAK_D, camera_path
from mock_hw.orchard.scene import fixtures
from mock_hw.orchard.tree import Tree

DENSITIES = (1, 2, 3, 4)
MOST_LEAVES = {"apple": 9000, "oak": 14000, "walnut": 2400}
_STEPS = 11


@dataclass(frozen=True, kw_only=True, slots=True)
class FoliageFit:
    """The leaf count of one density, the V_det it gives and the one that was wanted."""

    density: int
    leaf_count: int
    v_det: float
    target: float


@dataclass(frozen=True, kw_only=True, eq=False)
class Canopy:
    """All canopies of one tree at once, seen from some poses.

    vertex: per view the (H, W) skeleton vertices of the leafless tree; cover: per view the
    (H, W) number of the first leaf that hides it. known: V_det of the leaf counts asked for so far.
    """

    tree: Tree
    poses: list[FloatArray]
    intrinsics: Intrinsics
    vertex: list[Int32Array]
    cover: list[Int32Array]
    known: dict[int, float] = field(default_factory=dict)

    @cached_property
    def framed(self) -> BoolArray:
        """The (V,) skeleton vertices that lie inside the frame of some view."""
        return framed(self.tree, self.poses, self.intrinsics)

    @cached_property
    def piece(self) -> IntArray:
        """The (V,) pieces of straight wood."""
        return pieces_of(self.tree)

    def detected(self, leaf_count: int) -> BoolArray:
        """Return (V,) which skeleton vertices are detectable under so many leaves."""
        found = np.zeros(len(self.tree.position), dtype=bool)
        for vertex, cover, pose in zip(self.vertex, self.cover, self.poses, strict=True):
            seen = np.where(cover >= leaf_count, vertex, np.int32(-1))
            fragments = fragments_of(seen, self.tree, self.piece, pose, self.intrinsics)
            found[fragments.vertex[fragments.detectable[fragments.fragment]]] = True
        return found

    def v_det(self, leaf_count: int) -> float:
        """Return V_det under so many leaves."""
        if leaf_count not in self.known:
            self.known[leaf_count] = float(self.detected(leaf_count)[self.framed].mean())
        return self.known[leaf_count]


def framed(tree: Tree, poses: list[FloatArray], intrinsics: Intrinsics) -> BoolArray:
    """Return (V,) which skeleton vertices lie inside the frame of some view."""
    inside = np.zeros(len(tree.position), dtype=bool)
    for pose in poses:
        points = transform_points(invert(pose), tree.position)
        ahead = points[:, 2] > renderer.NEAR_M
        u, v = intrinsics.project(np.where(ahead[:, None], points, 1.0)).T
        inside |= (
            ahead
            & (u >= -0.5)
            & (v >= -0.5)
            & (u < intrinsics.width_px - 0.5)
            & (v < intrinsics.height_px - 0.5)
        )
    return inside


def canopy_of(
    tree: Tree,
    *,
    seed: int,
    trellis: bool,
    most_leaves: int,
    poses: list[FloatArray] | None = None,
    intrinsics: Intrinsics = OAK_D,
) -> Canopy:
    """Draw a tree once for all leaf counts up to `most_leaves` (default poses: the 10 views)."""
    poses = camera_path(10) if poses is None else poses
    bare = merged(fixtures(tree, seed, trellis=trellis))
    leaves = mesh_of_leaves(tree, most_leaves)
    per_leaf = triangles_per_leaf(tree.species.leaf)
    vertices, covers = [], []
    for pose in poses:
        picture = renderer.draw(bare, pose, intrinsics)
        cover = np.where(picture.vertex >= 0, most_leaves, -1).astype(np.int32)
        screen = renderer.project(leaves, pose, intrinsics)
        raster.first_cover(screen, leaves.triangles, per_leaf, 1.0 / picture.depth_m, cover)
        vertices.append(picture.vertex)
        covers.append(cover)
    return Canopy(tree=tree, poses=poses, intrinsics=intrinsics, vertex=vertices, cover=covers)


def fit_foliage(
    tree: Tree, densities: Sequence[int], *, seed: int, trellis: bool
) -> tuple[FoliageFit, ...]:
    """Find the leaf counts of foliage densities 1..4 by bisection; the tree is drawn once for all.

    Raises:
        UsageError: there is no such density.
    """
    for density in densities:
        if density not in DENSITIES:
            raise UsageError(f"no foliage density {density}; choose 1, 2, 3 or 4")
    most = MOST_LEAVES[tree.species.name]
    canopy = canopy_of(tree, seed=seed, trellis=trellis, most_leaves=most)
    return tuple(fit_canopy(canopy, density, most) for density in densities)


def fit_canopy(canopy: Canopy, density: int, most_leaves: int) -> FoliageFit:
    """Bisect on a canopy already drawn with `most_leaves`."""
    target = canopy.tree.species.detectable[density - 1]
    low, high = 0, most_leaves
    best = (abs(canopy.v_det(0) - target), 0, canopy.v_det(0))
    for _ in range(_STEPS):
        middle = (low + high) // 2
        v_det = canopy.v_det(middle)
        best = min(best, (abs(v_det - target), middle, v_det))
        low, high = (middle, high) if v_det > target else (low, middle)
        if high - low <= 1:
            break
    return FoliageFit(density=density, leaf_count=best[1], v_det=best[2], target=target)
