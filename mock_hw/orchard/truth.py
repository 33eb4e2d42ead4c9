"""The true skeleton as a document, with what the scan could and could not see."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from canopy_skel.document import Branch, Method, SkeletonDocument
from canopy_skel.geometry import BoolArray, IntArray
from mock_hw.orchard.instances import Fragments
from mock_hw.orchard.mesh import Int32Array
from mock_hw.orchard.tree import Tree

LEAST_SEEN_PX = 2


@dataclass(frozen=True, kw_only=True, eq=False, slots=True)
class Seen:
    """What views saw of a tree.

    pixels: (V,) most pixels of a vertex in one view. segmented: (V,) some instance covers it.
    """

    pixels: IntArray
    segmented: BoolArray


def nothing_seen(tree: Tree) -> Seen:
    """Return the record before the first view."""
    size = len(tree.position)
    return Seen(pixels=np.zeros(size, dtype=np.int64), segmented=np.zeros(size, dtype=bool))


def seen_also(seen: Seen, vertex: Int32Array, fragments: Fragments) -> Seen:
    """Add a view: its (H, W) skeleton vertices and its fragments."""
    pixels = np.bincount(vertex[vertex >= 0], minlength=len(seen.pixels))
    segmented = seen.segmented.copy()
    segmented[fragments.vertex[fragments.detectable[fragments.fragment]]] = True
    return Seen(pixels=np.maximum(seen.pixels, pixels), segmented=segmented)


def seen_together(parts: Iterable[Seen], tree: Tree) -> Seen:
    """Join what several sets of views saw."""
    whole = nothing_seen(tree)
    for part in parts:
        whole = Seen(
            pixels=np.maximum(whole.pixels, part.pixels),
            segmented=whole.segmented | part.segmented,
        )
    return whole


def truth_document(
    tree: Tree, seen: Seen, framed: BoolArray, *, scan_id: str, views: int
) -> SkeletonDocument:
    """Return the ground truth: all wood of the tree, hierarchy included.

    `occluded`: no view shows two pixels of the vertex. Extra arrays: `segmented`, some mask
    covers it; `framed`, it lies inside the frame of some view (what is not should not be scored).
    """
    return SkeletonDocument(
        scan_id=scan_id,
        revision=0,
        method=Method(name="ground_truth"),
        views_used=views,
        views_rejected=(),
        position=tree.position,
        radius=tree.radius_m,
        occluded=seen.pixels < LEAST_SEEN_PX,
        confidence=np.ones(len(tree.position)),
        edges=tree.edges(),
        branches=tuple(_branch(tree, k) for k in range(len(tree.branches))),
        root=0,
        components=1,
        extra={
            "segmented": tuple(bool(value) for value in seen.segmented),
            "framed": tuple(bool(value) for value in framed),
        },
    )


def _branch(tree: Tree, number: int) -> Branch:
    branch = tree.branches[number]
    line = tree.position[branch.vertices]
    return Branch(
        id=branch.id,
        parent=branch.parent,
        order=branch.order,
        kind="trunk" if branch.order == 0 else "branch",
        vertices=tuple(int(vertex) for vertex in branch.vertices),
        length=float(np.linalg.norm(np.diff(line, axis=0), axis=1).sum()),
        mean_radius=float(tree.radius_m[branch.vertices[1:]].mean()),
        confidence=1.0,
    )
