"""Degree-one B-spline with four control points through a cluster, and its radius (paper III-C)."""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from canopy_skel.cluster import BranchCluster, principal_axes
from canopy_skel.geometry import FloatArray


@dataclass(frozen=True, kw_only=True, slots=True)
class SplineConfig:
    """How a cluster becomes a polyline.

    control_points: the paper's four; each needs points that weigh at least `min_weight`.
    centre_shift: by how many radii the visible surface is moved away from the camera, pi/4 being
    the mean depth of a cylinder's front.
    radius: "extent" is the paper's half extent along PC2; "across" looks across the ray only,
    where depth noise cannot enter.
    """

    control_points: int = 4
    min_weight: float = 2.0
    centre_shift: float = np.pi / 4
    radius: Literal["extent", "across"] = "across"


@dataclass(frozen=True, kw_only=True, eq=False, slots=True)
class BranchSpline:
    """A polyline through a cluster: (n, 3) control points in base, n <= 4; radius in metres."""

    view_index: int
    instance: int
    confidence: float
    radius_m: float
    control_points_in_base: FloatArray


def fit_spline(cluster: BranchCluster, config: SplineConfig) -> BranchSpline:
    """Fit the paper's spline: least squares, degree one, uniform knots along PC1.

    Degree one makes the basis hat functions and the normal matrix tridiagonal. A knot span without
    points would make it singular: then fewer control points are used.
    """
    points = cluster.points_in_base
    _, axes = principal_axes(points)
    along = (points - points.mean(axis=0)) @ axes[0]
    along = (along - along.min()) / max(np.ptp(along), 1e-12)
    count = config.control_points
    basis = hat_basis(along, count)
    while count > 2 and basis.sum(axis=0).min() < config.min_weight:
        count -= 1
        basis = hat_basis(along, count)
    control_points = np.linalg.solve(basis.T @ basis, basis.T @ points)
    ray = direction_across(points.mean(axis=0) - cluster.camera_in_base, axes[0])
    sideways = np.cross(ray, axes[0])
    radius_m = radius_across((points - basis @ control_points) @ sideways) + cluster.margin_m
    return BranchSpline(
        view_index=cluster.view_index,
        instance=cluster.instance,
        confidence=cluster.confidence,
        radius_m=half_extent(points, axes[1]) if config.radius == "extent" else radius_m,
        control_points_in_base=control_points + config.centre_shift * radius_m * ray,
    )


def hat_basis(along: FloatArray, count: int) -> FloatArray:
    """Return (N, count): values of `count` uniform degree-one basis functions at (N,) in [0, 1]."""
    return np.maximum(0.0, 1.0 - np.abs(along[:, None] * (count - 1) - np.arange(count)))


def direction_across(vector: FloatArray, axis: FloatArray) -> FloatArray:
    """Return the unit direction (3,) of `vector` without its part along the unit `axis`.

    A vector along the axis has none: then any direction across the axis is returned.
    """
    across = vector - (vector @ axis) * axis
    if np.linalg.norm(across) < 1e-6 * np.linalg.norm(vector):
        across = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])
    return np.asarray(across / np.linalg.norm(across))


def half_extent(points: FloatArray, axis: FloatArray) -> float:
    """Return half the distance between the extreme points along an axis (paper III-C: radius)."""
    return float(np.ptp(points @ axis)) / 2.0


def radius_across(offsets_m: FloatArray) -> float:
    """Return the half width that (N,) sideways offsets, evenly spread over it, stand for."""
    return float(np.sqrt(3.0) * np.std(offsets_m))
