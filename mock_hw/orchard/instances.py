"""Branch instances as the paper labels them: slender, piecewise straight, visible in one image.

Each branch is cut where it bends or forks hard; what one image shows of a piece, as connected
pixels, is a fragment. Fragments large enough for a network to find are instances.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from canopy_skel.frame import Intrinsics, UInt16Array
from canopy_skel.geometry import BoolArray, FloatArray, IntArray, invert, transform_points
from mock_hw.orchard.kernels.components import components
from mock_hw.orchard.mesh import Int32Array
from mock_hw.orchard.tree import SPACING_M, Tree

BEND_DEG = 18.0
FORK_RADIUS_SHARE = 0.6
LEAST_PIXELS = 150
LEAST_SKELETON_M = 0.05
LEAST_WIDTH_PX = 2.5
_WINDOW = 3
_LEAST_VERTICES = 9


@dataclass(frozen=True, kw_only=True, eq=False, slots=True)
class Fragments:
    """The connected visible parts of all pieces in one image.

    label: (H, W) fragment 0, 1, … or -1. Per fragment (N,): pixels, skeleton_m (length of the
    skeleton it shows), width_px (mean), detectable. vertex, fragment: (K,) pairs, which skeleton
    vertex is seen in which fragment.
    """

    label: Int32Array
    pixels: IntArray
    skeleton_m: FloatArray
    width_px: FloatArray
    detectable: BoolArray
    vertex: IntArray
    fragment: IntArray


def pieces_of(tree: Tree) -> IntArray:
    """Return the (V,) piece of straight wood each vertex belongs to, numbered from the trunk up."""
    piece = np.empty(len(tree.position), dtype=np.int64)
    forks = _hard_forks(tree)
    cosine = np.cos(np.radians(BEND_DEG))
    count = 0
    for branch in tree.branches:
        own = branch.vertices if branch.parent is None else branch.vertices[1:]
        line = tree.position[branch.vertices]
        ahead = np.minimum(np.arange(len(line)) + _WINDOW, len(line) - 1)
        back = np.maximum(np.arange(len(line)) - _WINDOW, 0)
        heading = line[ahead] - line[back]
        heading = (heading / np.linalg.norm(heading, axis=1, keepdims=True))[-len(own) :]
        mean, since = heading[0], 0
        for k, vertex in enumerate(own):
            straight = heading[k] @ mean >= cosine * np.linalg.norm(mean)
            if k - since >= _LEAST_VERTICES and (not straight or forks[own[k - 1]]):
                count, mean, since = count + 1, np.zeros(3), k
            piece[vertex] = count
            mean = mean + heading[k]
        count += 1
    return piece


def _hard_forks(tree: Tree) -> BoolArray:
    """Return (V,) whether a branch of like strength leaves here."""
    forks = np.zeros(len(tree.position), dtype=bool)
    for branch in tree.branches[1:]:
        foot, first = branch.vertices[0], branch.vertices[1]
        forks[foot] |= tree.radius_m[first] >= FORK_RADIUS_SHARE * tree.radius_m[foot]
    return forks


def fragments_of(
    vertex: Int32Array,
    tree: Tree,
    piece: IntArray,
    base_from_camera: FloatArray,
    intrinsics: Intrinsics,
) -> Fragments:
    """Split an image of skeleton vertices (H, W; -1 = no wood) into fragments."""
    wood = np.flatnonzero(vertex >= 0)
    vertex_of_wood = vertex.ravel()[wood]
    piece_image = np.full(vertex.shape, -1, dtype=np.int32)
    piece_image.ravel()[wood] = piece[vertex_of_wood]
    label = np.empty(vertex.shape, dtype=np.int32)
    count = components(piece_image, label)
    label_of_wood = label.ravel()[wood]
    pairs = np.unique(label_of_wood.astype(np.int64) * len(piece) + vertex_of_wood)
    fragment, shown = pairs // len(piece), pairs % len(piece)
    step_px = _projected_steps(tree, base_from_camera, intrinsics)
    pixels = np.bincount(label_of_wood, minlength=count)
    skeleton_m = np.bincount(fragment, minlength=count).astype(np.float64) * SPACING_M
    length_px = np.bincount(fragment, weights=step_px[shown], minlength=count)
    width_px = pixels / np.maximum(length_px, 1e-9)
    detectable = (
        (pixels >= LEAST_PIXELS) & (skeleton_m >= LEAST_SKELETON_M) & (width_px >= LEAST_WIDTH_PX)
    )
    return Fragments(
        label=label,
        pixels=pixels,
        skeleton_m=skeleton_m,
        width_px=width_px,
        detectable=detectable,
        vertex=shown,
        fragment=fragment,
    )


def _projected_steps(
    tree: Tree, base_from_camera: FloatArray, intrinsics: Intrinsics
) -> FloatArray:
    """Return the (V,) length in pixels of the step of skeleton that each vertex stands for."""
    points = transform_points(invert(base_from_camera), tree.position)
    points[:, 2] = np.maximum(points[:, 2], 0.05)
    uv = intrinsics.project(points)
    below = np.where(tree.parent >= 0, tree.parent, 1)
    return np.asarray(np.linalg.norm(uv - uv[below], axis=1))


def instances_of(
    fragments: Fragments, rng: np.random.Generator
) -> tuple[UInt16Array, tuple[float, ...]]:
    """Return the (H, W) instance image (0 = none) of detectable fragments, and their scores.

    A score rises with the size and the width of what is seen, with some luck.
    """
    chosen = np.flatnonzero(fragments.detectable)
    number = np.zeros(len(fragments.pixels) + 1, dtype=np.uint16)
    number[chosen] = np.arange(1, len(chosen) + 1)
    clear = clarity(fragments.pixels[chosen], fragments.width_px[chosen])
    scores = np.clip(clear + rng.normal(0, 0.06, len(chosen)), 0.5, 0.99)
    return number[fragments.label], tuple(round(float(score), 3) for score in scores)


def clarity(pixels: ArrayLike, width_px: ArrayLike) -> FloatArray:
    """Return how sure a good detector would be of fragments of this many pixels and mean width."""
    size = np.log(np.asarray(pixels) / LEAST_PIXELS)
    width = np.log(np.asarray(width_px) / LEAST_WIDTH_PX)
    return np.asarray(0.62 + 0.065 * size + 0.06 * width)
