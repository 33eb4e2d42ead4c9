"""Mask x depth -> slender 3-D point clusters (paper III-B), filtered for real depth cameras."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import chain

import cv2
import numpy as np
from scipy.ndimage import label

from canopy_skel.errors import ViewError
from canopy_skel.frame import Intrinsics, View
from canopy_skel.geometry import BoolArray, FloatArray, IntArray, transform_points
from canopy_skel.kernels.strip import measure
from canopy_skel.segment import BranchMask

FARTHEST_M = 3.0
"""From the camera. An arm works within a metre or two of it; the next row begins behind that."""


@dataclass(frozen=True, kw_only=True, slots=True)
class ClusterConfig:
    """Which points of a mask are trusted.

    Masks bleed over edges and depth lies near them, so the mask is eroded by `erosion_px` (unless
    less than `min_eroded_share` would be left) and depth must lie in [nearest_m, farthest_m]: the
    next row of trees is wood as well, but not this tree's.
    Along a straight piece of wood disparity (1 / depth) is linear in the picture: a robust profile
    (best of `draws` random lines, then reweighted parabolas) is fitted and what is further than
    `tolerance_m` from it in depth is cut; beyond 1.25 m the tolerance grows with the square of the
    distance, as stereo noise does. Where less than `min_trusted_share` of the mask's pixels are
    left, the profile is as likely the background's. What does not touch in cells of `connect_m` is
    split; parts under `min_points` are dropped, and those whose second principal deviation exceeds
    `max_flatness` of the first: blobs are not branches.
    """

    erosion_px: int = 1
    min_eroded_share: float = 0.5
    nearest_m: float = 0.3
    farthest_m: float = FARTHEST_M
    draws: int = 60
    tolerance_m: float = 0.02
    min_trusted_share: float = 0.4
    connect_m: float = 0.03
    min_points: int = 20
    max_flatness: float = 0.55


@dataclass(frozen=True, kw_only=True, eq=False, slots=True)
class BranchCluster:
    """The visible surface of one slender piece of wood.

    points_in_base: (N, 3). camera_in_base: (3,), where it was seen from. confidence: the mask's.
    half_width_m: of the whole mask, at the depth of the wood's axis and across the viewing ray.
    """

    view_index: int
    instance: int
    confidence: float
    half_width_m: float
    camera_in_base: FloatArray
    points_in_base: FloatArray


@dataclass(frozen=True, kw_only=True, slots=True)
class RejectedInstance:
    """An instance, or a part of one, that gave no cluster."""

    view_index: int
    instance: int
    reason: str


def cluster_branches(
    view: View, masks: Iterable[BranchMask], config: ClusterConfig
) -> tuple[list[BranchCluster], list[RejectedInstance]]:
    """Lift the masks of a view into base.

    Raises:
        ViewError: the view has no depth.
    """
    results = [_clusters_of_mask(view, mask, config) for mask in masks]
    clusters = list(chain.from_iterable(found for found, _ in results))
    rejected = [
        RejectedInstance(view_index=view.index, instance=instance, reason=reason)
        for _, reasons in results
        for instance, reason in reasons
    ]
    return clusters, rejected


def _clusters_of_mask(
    view: View, mask: BranchMask, config: ClusterConfig
) -> tuple[list[BranchCluster], Sequence[tuple[int, str]]]:
    inner = eroded(mask.mask, config.erosion_px, config.min_eroded_share)
    in_camera = _trusted_points(view, mask, inner, config)
    if len(in_camera) < max(config.min_points, config.min_trusted_share * inner.sum()):
        return [], [(mask.instance, "too few points with trusted depth")]
    strip = np.empty(5)
    measure(mask.mask, strip)
    clusters, reasons = [], []
    for part in connected_parts(in_camera, config.connect_m):
        points = in_camera[part]
        if len(points) < config.min_points:
            reasons.append((mask.instance, "part too small"))
        elif flatness(points) > config.max_flatness:
            reasons.append((mask.instance, "not slender"))
        else:
            clusters.append(
                BranchCluster(
                    view_index=view.index,
                    instance=mask.instance,
                    confidence=mask.confidence,
                    half_width_m=half_width_m(strip, mask, points, view.intrinsics),
                    camera_in_base=view.base_from_camera[:3, 3],
                    points_in_base=transform_points(view.base_from_camera, points),
                )
            )
    return clusters, reasons


def _trusted_points(
    view: View, mask: BranchMask, inner: BoolArray, config: ClusterConfig
) -> FloatArray:
    """Return the points (N, 3) in the camera frame whose depth follows the mask's profile."""
    if view.depth_m is None:
        raise ViewError(f"view {view.index}: no depth; compute it from the stereo pair first")
    v, u = np.nonzero(inner)
    u, v = u + mask.left_px, v + mask.top_px
    depth_m = view.depth_m[v, u].astype(np.float64)
    usable = (depth_m >= config.nearest_m) & (depth_m <= config.farthest_m)
    u, v, depth_m = u[usable], v[usable], depth_m[usable]
    if len(depth_m) >= config.min_points:
        pixels = np.stack([u, v], axis=1).astype(np.float64)
        _, _, axes = np.linalg.svd(pixels - pixels.mean(axis=0), full_matrices=False)
        follows = follows_profile((pixels - pixels.mean(axis=0)) @ axes[0], 1.0 / depth_m, config)
        u, v, depth_m = u[follows], v[follows], depth_m[follows]
    return view.intrinsics.back_project(u.astype(np.float64), v.astype(np.float64), depth_m)


def half_width_m(
    strip: FloatArray, mask: BranchMask, points: FloatArray, camera: Intrinsics
) -> float:
    """Return the radius of the round wood whose outline a mask is, from `strip.measure` of it.

    The outline of a cylinder lies beside its axis, pi/4 of a radius behind its front on average.

    Args:
        strip: half width in pixels, mean pixel, direction.
        mask: what was measured.
        points: its front (N, 3) in the camera frame.
        camera: that saw it.
    """
    half_px, u, v, along_u, along_v = strip.tolist()
    ray = camera.back_project(np.array([u + mask.left_px]), np.array([v + mask.top_px]), np.ones(1))
    ray = ray[0] / np.linalg.norm(ray[0])
    slant = float(ray[1] * along_u - ray[0] * along_v)
    tangent = half_px / camera.fx_px * np.sqrt(1.0 - slant**2)
    return float(np.median(points[:, 2]) * tangent / (1.0 - np.pi / 4 * tangent))


def follows_profile(along: FloatArray, disparity: FloatArray, config: ClusterConfig) -> BoolArray:
    """Say which of N pixels lie on the robust profile of disparity (1/m) along a mask's axis."""
    along = along / max(float(np.abs(along).max()), 1e-12)
    fit = _best_line(along, disparity, config)
    design = np.stack([np.ones_like(along), along, along**2], axis=1)
    for _ in range(6):
        residual = np.abs(disparity - fit) / tolerance_in_disparity(fit, config)
        weight = np.where(residual < 1.0, (1.0 - residual**2) ** 2, 0.0)
        weighted = design * weight[:, None]
        # A slight pull towards a level line keeps the fit defined where few points agree.
        normal = weighted.T @ design + 1e-6 * len(along) * np.eye(3)
        fit = design @ np.linalg.solve(normal, weighted.T @ disparity)
    return np.asarray(np.abs(disparity - fit) <= tolerance_in_disparity(fit, config))


def tolerance_in_disparity(disparity: FloatArray, config: ClusterConfig) -> FloatArray:
    """Return what the depth tolerance is in disparity (1/m); constant beyond 1.25 m."""
    return config.tolerance_m * np.maximum(disparity, 0.8) ** 2


def _best_line(along: FloatArray, disparity: FloatArray, config: ClusterConfig) -> FloatArray:
    """Return the line through two of the pixels that the others agree with best, at all pixels."""
    pairs = np.random.default_rng(0).integers(0, len(along), (config.draws, 2))
    run = along[pairs[:, 1]] - along[pairs[:, 0]]
    pairs, run = pairs[np.abs(run) > 0.3], run[np.abs(run) > 0.3]
    if len(pairs) == 0:
        return np.full(len(along), np.median(disparity))
    slope = (disparity[pairs[:, 1]] - disparity[pairs[:, 0]]) / run
    lines = disparity[pairs[:, :1]] + slope[:, None] * (along - along[pairs[:, :1]])
    tolerance = tolerance_in_disparity(np.median(disparity, keepdims=True), config)
    misfit = np.minimum(np.abs(disparity - lines), tolerance).sum(axis=1)
    best: FloatArray = lines[np.argmin(misfit)]
    return best


def eroded(mask: BoolArray, erosion_px: int, min_share: float) -> BoolArray:
    """Shave `erosion_px` off an (h, w) mask, or keep it where too little would be left."""
    padded = np.pad(mask.astype(np.uint8), erosion_px)
    kernel = np.ones((3, 3), dtype=np.uint8)
    inner = cv2.erode(padded, kernel, iterations=erosion_px).astype(bool)
    inner = inner[erosion_px : -erosion_px or None, erosion_px : -erosion_px or None]
    return inner if inner.sum() >= min_share * mask.sum() else mask


def connected_parts(points: FloatArray, cell_m: float) -> list[IntArray]:
    """Split (N, 3) points into groups that touch in cells of this size; indices, largest first."""
    cells = np.floor((points - points.min(axis=0)) / cell_m).astype(np.int64)
    occupied = np.zeros(cells.max(axis=0) + 1, dtype=bool)
    occupied[tuple(cells.T)] = True
    labels, count = label(occupied, structure=np.ones((3, 3, 3)))
    of_point = labels[tuple(cells.T)]
    parts = [np.flatnonzero(of_point == number) for number in range(1, count + 1)]
    return sorted(parts, key=len, reverse=True)


def principal_axes(points: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return deviations (3,) in metres, descending, and unit axes as rows (3, 3) of (N, 3) points.

    The sign of each axis is canonical: its largest component is positive.
    """
    centred = points - points.mean(axis=0)
    variance, vectors = np.linalg.eigh(centred.T @ centred / len(points))
    axes = vectors.T[::-1]
    sign = np.sign(axes[np.arange(3), np.argmax(np.abs(axes), axis=1)])
    return np.sqrt(np.maximum(variance[::-1], 0.0)), axes * sign[:, None]


def flatness(points: FloatArray) -> float:
    """Return the ratio of second to first principal deviation: 0 a line, 1 a blob or a dot."""
    deviation, _ = principal_axes(points)
    return float(deviation[1] / deviation[0]) if deviation[0] > 1e-9 else 1.0
