"""Mask x depth -> clusters one instance after the other, with numpy, OpenCV and scipy."""

import cv2
import numpy as np
from scipy.ndimage import label

from canopy_skel.cluster import half_width_m, principal_axes
from canopy_skel.geometry import transform_points
from canopy_skel.kernels.strip import measure


def clusters_of_mask(view, mask, config):
    """Return the points in base of each part, and why other parts gave none."""
    inner = eroded(mask.mask, config.erosion_px, config.min_eroded_share)
    in_camera = trusted_points(view, mask, inner, config)
    if len(in_camera) < max(config.min_points, config.min_trusted_share * inner.sum()):
        return [], ["too few points with trusted depth"]
    clusters, reasons = [], []
    for part in connected_parts(in_camera, config.connect_m):
        points = in_camera[part]
        if len(points) < config.min_points:
            reasons.append("part too small")
        elif flatness(points) > config.max_flatness:
            reasons.append("not slender")
        else:
            strip = np.empty(5)
            measure(mask.mask, strip)
            width = half_width_m(strip, mask, float(np.median(points[:, 2])), view.intrinsics)
            clusters.append((transform_points(view.base_from_camera, points), width))
    return clusters, reasons


def trusted_points(view, mask, inner, config):
    """Return the points (N, 3) in the camera frame whose depth follows the mask's profile."""
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


def follows_profile(along, disparity, config):
    """Say which of N pixels lie on the robust profile of disparity (1/m) along a mask's axis."""
    along = along / max(float(np.abs(along).max()), 1e-12)
    fit = best_line(along, disparity, config)
    design = np.stack([np.ones_like(along), along, along**2], axis=1)
    for _ in range(6):
        residual = np.abs(disparity - fit) / tolerance_in_disparity(fit, config)
        weight = np.where(residual < 1.0, (1.0 - residual**2) ** 2, 0.0)
        weighted = design * weight[:, None]
        # A slight pull towards a level line keeps the fit defined where few points agree.
        normal = weighted.T @ design + 1e-6 * len(along) * np.eye(3)
        fit = design @ np.linalg.solve(normal, weighted.T @ disparity)
    return np.asarray(np.abs(disparity - fit) <= tolerance_in_disparity(fit, config))


def tolerance_in_disparity(disparity, config):
    """Return what the depth tolerance is in disparity (1/m); constant beyond 1.25 m."""
    return config.tolerance_m * np.maximum(disparity, 0.8) ** 2


def best_line(along, disparity, config):
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
    best = lines[np.argmin(misfit)]
    return best


def eroded(mask, erosion_px, min_share):
    """Shave `erosion_px` off an (h, w) mask, or keep it where too little would be left."""
    padded = np.pad(mask.astype(np.uint8), erosion_px)
    kernel = np.ones((3, 3), dtype=np.uint8)
    inner = cv2.erode(padded, kernel, iterations=erosion_px).astype(bool)
    inner = inner[erosion_px : -erosion_px or None, erosion_px : -erosion_px or None]
    return inner if inner.sum() >= min_share * mask.sum() else mask


def connected_parts(points, cell_m):
    """Split (N, 3) points into groups that touch in cells of this size; indices, largest first."""
    cells = np.floor((points - points.min(axis=0)) / cell_m).astype(np.int64)
    occupied = np.zeros(cells.max(axis=0) + 1, dtype=bool)
    occupied[tuple(cells.T)] = True
    labels, count = label(occupied, structure=np.ones((3, 3, 3)))
    of_point = labels[tuple(cells.T)]
    parts = [np.flatnonzero(of_point == number) for number in range(1, count + 1)]
    return sorted(parts, key=len, reverse=True)


def flatness(points):
    """Return the ratio of second to first principal deviation: 0 a line, 1 a blob or a dot."""
    deviation, _ = principal_axes(points)
    return float(deviation[1] / deviation[0]) if deviation[0] > 1e-9 else 1.0
