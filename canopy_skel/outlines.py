"""What one view shows of the sides of thick wood: points on its bark, and where its outline is.

Leaves cut the mask of a trunk into strips. How wide a strip is says little of the trunk; where bark
lies in space, and where it ends before something farther away, does.
"""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from canopy_skel.frame import Float32Array, View
from canopy_skel.geometry import FloatArray, IntArray
from canopy_skel.kernels import outlines
from canopy_skel.pieces import Piece, PieceConfig, Regions, depth_of, usable_depth

BARK = 10
"""Figures of a point on bark: place, ray from the camera, direction and radius of its piece."""
OUTLINE = 12
"""Figures of a point on an outline: place, ray, the way across the wood, direction of its piece."""
THINNEST_M = 0.008
_PER_PIECE = 64
_OFF_M, _OFF_RADII = 0.02, 1.5
_BEHIND_M = 0.08


@dataclass(frozen=True, kw_only=True, eq=False, slots=True)
class Outlines:
    """What one view shows of wood of at least `THINNEST_M` in radius, in base.

    bark: (N, BARK). outline: (M, OUTLINE).
    """

    bark: FloatArray
    outline: FloatArray


def outlines_of(view: View, regions: Regions, pieces: list[Piece], config: PieceConfig) -> Outlines:
    """Return what a view shows of the sides of its instances.

    Args:
        view: with depth.
        regions: pixels of the instances.
        pieces: made of them; those of fragments do not count.
        config: which depth counts.
    """
    thick = [p for p in pieces if not p.fragment and p.spline.radius_m >= THINNEST_M]
    region = {number: i for i, number in enumerate(regions.numbers.tolist())}
    which = [region[piece.spline.instance] for piece in thick]
    ranges = [np.arange(regions.start[i], regions.start[i + 1]) for i in which]
    pixels = np.concatenate([np.zeros(0, np.int64), *ranges])
    start = np.cumsum([0, *map(len, ranges)])
    u, v = (side[pixels].astype(np.float64) for side in (regions.u, regions.v))
    depth_m = np.ascontiguousarray(depth_of(view), dtype=np.float32)
    there = usable_depth(depth_m[regions.v[pixels], regions.u[pixels]], config)
    picked, of = _picked(there, start)
    middle_m = np.array([np.median(there[picked[of == i]]) for i in range(len(thick))], np.float64)
    rims = outlines.rims(u, v, start, depth_m, middle_m, _BEHIND_M)
    return Outlines(
        bark=_bark(view, thick, u[picked], v[picked], there[picked], of),
        outline=_outline(view, thick, rims),
    )


def _picked(depth_m: Float32Array, start: IntArray) -> tuple[IntArray, IntArray]:
    """Return some pixels with depth of each region, evenly spread, and whose they are."""
    picked = [np.zeros(0, np.int64)]
    for begin, end in pairwise(start):
        has = begin + np.flatnonzero(np.isfinite(depth_m[begin:end]))
        some = np.linspace(0, len(has) - 1, min(len(has), _PER_PIECE)).astype(np.int64)
        picked.append(has[some])
    of = np.repeat(np.arange(len(start) - 1), [len(one) for one in picked[1:]])
    return np.concatenate(picked), of


def _bark(
    view: View,
    thick: list[Piece],
    u: FloatArray,
    v: FloatArray,
    depth_m: Float32Array,
    of: IntArray,
) -> FloatArray:
    """Return points on bark (N, BARK), those far off the line of their piece left out."""
    rotation, eye = view.base_from_camera[:3, :3], view.base_from_camera[:3, 3]
    ray = view.intrinsics.back_project(u, v, depth_m.astype(np.float64)) @ rotation.T
    first, way = _chords(thick)
    points = ray + eye
    offset = points - first[of]
    across = offset - np.sum(offset * way[of], axis=1, keepdims=True) * way[of]
    radius_m = np.array([piece.spline.radius_m for piece in thick])[of]
    near = np.linalg.norm(across, axis=1) < _OFF_M + _OFF_RADII * radius_m
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    bark: FloatArray = np.column_stack([points, ray, way[of], radius_m])[near]
    return bark


def _outline(view: View, thick: list[Piece], rims: FloatArray) -> FloatArray:
    """Return points on outlines (M, OUTLINE)."""
    rotation, eye = view.base_from_camera[:3, :3], view.base_from_camera[:3, 3]
    u, v, qu, qv, depth_m, of = rims.T
    ray = view.intrinsics.back_project(u, v, depth_m) @ rotation.T
    inward = np.column_stack([qu, qv, np.zeros(len(qu))]) @ rotation.T
    points = ray + eye
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    return np.column_stack([points, ray, inward, _chords(thick)[1][of.astype(np.int64)]])


def _chords(pieces: list[Piece]) -> tuple[FloatArray, FloatArray]:
    """Return where pieces begin (P, 3), and the directions to their ends (P, 3)."""
    lines = [piece.spline.control_points_in_base for piece in pieces]
    first = np.array([line[0] for line in lines]).reshape(-1, 3)
    way = np.array([line[-1] for line in lines]).reshape(-1, 3) - first
    return first, way / np.maximum(np.linalg.norm(way, axis=1, keepdims=True), 1e-12)
