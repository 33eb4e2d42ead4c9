"""Instances as one picture shows them: connected, straight in the picture, with a middle line."""

from dataclasses import dataclass

import numpy as np

from canopy_skel.frame import Intrinsics, UInt16Array
from canopy_skel.geometry import BoolArray, FloatArray, IntArray, invert, transform_points
from mock_hw.orchard.kernels.components import components
from mock_hw.orchard.mesh import Int32Array
from mock_hw.orchard.tree import Tree

LEAST_PIXELS = 120
LEAST_LENGTH_PX = 25.0
LEAST_WIDTH_PX = 2.3
BRIDGE_PX = 8.0
"""A branch goes on behind what hides less of it than this: a wire, a petiole, a leaf's edge."""
BEND_SHARE = 0.08
_BEND_PX = 2.0
_BEND_RADII = 0.5


@dataclass(frozen=True, kw_only=True, eq=False, slots=True)
class Labels:
    """instances, lines and ignore as in `canopy_skel.segmenters.labels.LabelledImage`."""

    instances: UInt16Array
    lines: tuple[FloatArray, ...]
    ignore: BoolArray


def labels_in(
    vertex: Int32Array, tree: Tree, base_from_camera: FloatArray, intrinsics: Intrinsics
) -> Labels:
    """Label an image of skeleton vertices (H, W; -1 = no wood).

    What shows of a branch is cut where its line leaves the chord by more than a share of its
    length (8 % is a bend of 18 degrees in the middle).
    """
    uvr = _projected(tree, base_from_camera, intrinsics)
    instances = np.zeros(vertex.size, dtype=np.uint16)
    lines: list[FloatArray] = []
    flat = vertex.ravel()
    for own in _visible_stretches(vertex, tree, uvr):
        shown = flat[own]
        low, high = int(shown.min()), int(shown.max())
        for first, last in _straight(uvr[low : high + 1]):
            line = uvr[low + first : low + last + 1]
            mine = own[(shown >= low + first) & (shown < low + last + (last == high - low))]
            if _findable(line, len(mine)):
                lines.append(line)
                instances[mine] = len(lines)
    image = instances.reshape(vertex.shape)
    return Labels(instances=image, lines=tuple(lines), ignore=(vertex >= 0) & (image == 0))


def _visible_stretches(vertex: Int32Array, tree: Tree, uvr: FloatArray) -> list[IntArray]:
    """Return the pixels of each stretch of a branch that shows, gaps of a few pixels bridged."""
    seen = vertex >= 0
    region = np.empty(vertex.shape, dtype=np.int32)
    count = components(np.where(seen, tree.branch[vertex], -1).astype(np.int32), region)
    flat, pixels = vertex.ravel(), np.flatnonzero(seen)
    home = region.ravel()[pixels]
    low, high = np.full(count, len(tree.branch)), np.full(count, -1)
    np.minimum.at(low, home, flat[pixels])
    np.maximum.at(high, home, flat[pixels])
    stretch = np.empty(count, dtype=np.int64)
    reached = own = -1
    for part in np.lexsort([low, tree.branch[low]]):
        gap = np.linalg.norm(uvr[low[part], :2] - uvr[reached, :2])
        goes_on = tree.branch[low[part]] == tree.branch[reached] and gap <= BRIDGE_PX
        if own < 0 or not (goes_on or low[part] <= reached):
            own, reached = part, -1
        stretch[part] = own
        reached = max(reached, int(high[part]))
    home = stretch[home].astype(np.int32)
    order = np.argsort(home, kind="stable")
    starts = np.flatnonzero(np.diff(home[order], prepend=-1))
    stretches = np.split(pixels[order], starts[1:])
    return [stretch for stretch in stretches if len(stretch) >= LEAST_PIXELS]


def _findable(line: FloatArray, pixels: int) -> bool:
    length = float(np.linalg.norm(np.diff(line[:, :2], axis=0), axis=1).sum())
    width = pixels / max(length, 1e-9)
    slender = length > 1.2 * width
    return (
        pixels >= LEAST_PIXELS and length >= LEAST_LENGTH_PX and width >= LEAST_WIDTH_PX and slender
    )


def _projected(tree: Tree, base_from_camera: FloatArray, intrinsics: Intrinsics) -> FloatArray:
    """Return (V, 3) u, v and radius in pixels of the skeleton."""
    points = transform_points(invert(base_from_camera), tree.position)
    points[:, 2] = np.maximum(points[:, 2], 0.05)
    radius = intrinsics.fx_px * tree.radius_m / points[:, 2]
    return np.column_stack([intrinsics.project(points), radius])


def _straight(uvr: FloatArray) -> list[tuple[int, int]]:
    """Return first and last index of the straight stretches of a line (Douglas & Peucker)."""
    done: list[tuple[int, int]] = []
    todo = [(0, len(uvr) - 1)]
    while todo:
        first, last = todo.pop()
        cut = _bend(uvr[first : last + 1])
        if cut is None:
            done.append((first, last))
        else:
            todo += [(first + cut, last), (first, first + cut)]
    return done


def _bend(uvr: FloatArray) -> int | None:
    """Return where a line is farthest from its chord, if that is a bend."""
    if len(uvr) < 5:
        return None
    chord = uvr[-1, :2] - uvr[0, :2]
    length = float(np.linalg.norm(chord))
    if length < 2 * LEAST_LENGTH_PX:
        return None
    away = uvr[:, :2] - uvr[0, :2]
    offset = np.abs(away[:, 0] * chord[1] - away[:, 1] * chord[0]) / length
    worst = int(offset.argmax())
    allowed = max(_BEND_PX, BEND_SHARE * length, _BEND_RADII * float(uvr[:, 2].mean()))
    ends = min(worst, len(uvr) - 1 - worst)
    return worst if offset[worst] > allowed and ends >= 2 else None
