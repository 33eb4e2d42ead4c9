"""Instances as one picture shows them: connected, straight in the picture, with a middle line."""

from dataclasses import dataclass

import numpy as np

from canopy_skel.frame import Intrinsics, UInt16Array
from canopy_skel.geometry import BoolArray, FloatArray, invert, transform_points
from mock_hw.orchard.kernels.components import components
from mock_hw.orchard.mesh import Int32Array
from mock_hw.orchard.tree import Tree

LEAST_PIXELS = 120
LEAST_LENGTH_PX = 25.0
LEAST_WIDTH_PX = 2.3
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

    What shows of a branch as connected pixels is cut where its line leaves the chord by more
    than a share of its length (8 % is a bend of 18 degrees in the middle).
    """
    uvr = _projected(tree, base_from_camera, intrinsics)
    seen = vertex >= 0
    region = np.empty(vertex.shape, dtype=np.int32)
    components(np.where(seen, tree.branch[vertex], -1).astype(np.int32), region)
    pixels = np.flatnonzero(seen)
    pixels = pixels[np.argsort(region.ravel()[pixels], kind="stable")]
    starts = np.flatnonzero(np.diff(region.ravel()[pixels], prepend=-1))
    instances = np.zeros(vertex.size, dtype=np.uint16)
    lines: list[FloatArray] = []
    for own in np.split(pixels, starts[1:]):
        if len(own) < LEAST_PIXELS:
            continue
        shown = vertex.ravel()[own]
        low, high = int(shown.min()), int(shown.max())
        for first, last in _straight(uvr[low : high + 1]):
            line = uvr[low + first : low + last + 1]
            mine = own[(shown >= low + first) & (shown < low + last + (last == high - low))]
            if _findable(line, len(mine)):
                lines.append(line)
                instances[mine] = len(lines)
    image = instances.reshape(vertex.shape)
    return Labels(instances=image, lines=tuple(lines), ignore=seen & (image == 0))


def _findable(line: FloatArray, pixels: int) -> bool:
    length = float(np.linalg.norm(np.diff(line[:, :2], axis=0), axis=1).sum())
    width = pixels / max(length, 1e-9)
    slender = length > 1.2 * width
    return pixels >= LEAST_PIXELS and length >= LEAST_LENGTH_PX and width >= LEAST_WIDTH_PX and slender


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

