"""Recovered volume: how much wood a skeleton with radii stands for (paper, Figs. 7 and 8)."""

import numpy as np

from canopy_skel.document import SkeletonDocument
from canopy_skel.errors import UsageError
from canopy_skel.exports.tubes import start_radius_m
from canopy_skel.geometry import BoolArray, FloatArray
from canopy_skel.kernels import volume as kernel

VOXEL_M = 0.002
"""A third of the thinnest twigs' width; halving it changes a tree's volume by under a percent."""


def wood_volume_m3(
    document: SkeletonDocument, *, among: BoolArray | None = None, voxel_m: float = VOXEL_M
) -> float:
    """Return the volume of the union of the document's tapered tubes with round ends, in m3.

    The paper replaces vertices by balls of their radius; tubes are what dense vertices make of
    that. It is a union because tubes overlap at every fork, where a side branch starts on its
    parent's axis, and wherever one branch was drawn twice: wood that is there once counts once.
    A side branch is no thicker on its parent's axis than at its own first vertex.

    Args:
        document: a skeleton cut into branches.
        among: (V,) only tubes with both ends among these vertices; all when not given.
        voxel_m: resolution; volumes of thinner wood are right on average only.

    Raises:
        UsageError: the resolution is not positive.
    """
    if not voxel_m > 0:
        raise UsageError(f"voxel {voxel_m} m: give a length above 0, such as {VOXEL_M}")
    starts, ends, radii_m = _tubes(document, among)
    if len(starts) == 0:
        return 0.0
    margin = radii_m.max() + voxel_m
    origin = np.minimum(starts, ends).min(axis=0) - margin
    far = np.maximum(starts, ends).max(axis=0) + margin
    starts, ends, radii = (starts - origin) / voxel_m, (ends - origin) / voxel_m, radii_m / voxel_m
    top = np.zeros(np.ceil((far - origin) / voxel_m / 8.0).astype(int) + 1, dtype=np.int32)
    kernel.mark_blocks(starts, ends, radii, top)
    used = np.flatnonzero(top)
    top.ravel()[used] = np.arange(len(used))
    filled = np.zeros((len(used), 512), dtype=np.uint8)
    kernel.fill_tubes(starts, ends, radii, top, filled)
    return float(filled.sum(dtype=np.int64)) * voxel_m**3


def _tubes(
    document: SkeletonDocument, among: BoolArray | None
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return starts, ends (N, 3) and radii (N, 2) of the tubes in metres."""
    if not document.branches:
        return np.zeros((0, 3)), np.zeros((0, 3)), np.zeros((0, 2))
    vertex = np.concatenate([branch.vertices for branch in document.branches])
    radius_m = start_radius_m(document)
    last = np.cumsum([len(branch.vertices) for branch in document.branches]) - 1
    step = np.delete(np.arange(len(vertex)), last)
    if among is not None:
        step = step[among[vertex[step]] & among[vertex[step + 1]]]
    position = document.position[vertex]
    radii = np.stack([radius_m[step], radius_m[step + 1]], axis=1)
    return position[step], position[step + 1], radii
