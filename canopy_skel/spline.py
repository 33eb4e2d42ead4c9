"""Degree-one B-spline with four control points through a cluster, and its radius (paper III-C)."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from canopy_skel.cluster import BranchCluster
from canopy_skel.errors import UsageError
from canopy_skel.geometry import FloatArray
from canopy_skel.kernels import fit


@dataclass(frozen=True, kw_only=True, slots=True)
class SplineConfig:
    """How a cluster becomes a polyline.

    control_points: the paper's four; each needs points that weigh at least `min_weight`.
    centre_shift: by how many radii the visible surface is moved away from the camera, pi/4 being
    the mean depth of a cylinder's front.
    radius: "extent" is the paper's half extent along PC2; "outline" is half the mask's width, where
    neither depth noise nor holes in depth can enter.
    """

    control_points: int = 4
    min_weight: float = 2.0
    centre_shift: float = np.pi / 4
    radius: Literal["extent", "outline"] = "outline"

    def __post_init__(self) -> None:
        """Refuse what is no polyline."""
        if self.control_points < 2:
            raise UsageError(
                f"control_points {self.control_points}: a polyline has two at least; the paper's"
                " are 4"
            )


@dataclass(frozen=True, kw_only=True, eq=False, slots=True)
class BranchSpline:
    """A polyline through a cluster: (n, 3) control points in base, n <= 4; radius in metres."""

    view_index: int
    instance: int
    confidence: float
    radius_m: float
    control_points_in_base: FloatArray


def fit_splines(clusters: Sequence[BranchCluster], config: SplineConfig) -> list[BranchSpline]:
    """Fit the paper's spline to each cluster: least squares, degree one, uniform knots along PC1.

    Degree one makes the basis hat functions and the normal matrix tridiagonal. A knot span without
    points would make it singular: then fewer control points are used.
    """
    if not clusters:
        return []
    points = np.concatenate([cluster.points_in_base for cluster in clusters])
    start = np.append(0, np.cumsum([len(cluster.points_in_base) for cluster in clusters]))
    controls = np.zeros((len(clusters), config.control_points, 3))
    axes, means = np.zeros((len(clusters), 3, 3)), np.zeros((len(clusters), 3))
    counts = np.zeros(len(clusters), dtype=np.int64)
    fit.fit_splines(
        points, start, len(controls[0]), config.min_weight, controls, axes, means, counts
    )
    cameras = np.array([cluster.camera_in_base for cluster in clusters])
    rays = directions_across(means - cameras, axes[:, 0])
    outline_m = np.array([cluster.half_width_m for cluster in clusters])
    radius_m = outline_m
    if config.radius == "extent":
        radius_m = np.zeros(len(clusters))
        fit.half_extents(points, start, axes, radius_m)
    controls += (config.centre_shift * outline_m[:, None] * rays)[:, None]
    return [
        BranchSpline(
            view_index=cluster.view_index,
            instance=cluster.instance,
            confidence=cluster.confidence,
            radius_m=float(radius_m[i]),
            control_points_in_base=controls[i, : counts[i]],
        )
        for i, cluster in enumerate(clusters)
    ]


def directions_across(vectors: FloatArray, axes: FloatArray) -> FloatArray:
    """Return the unit directions (N, 3) of `vectors` without their parts along the unit `axes`.

    A vector along its axis has none: then any direction across the axis is returned.
    """
    across = vectors - (vectors * axes).sum(axis=1)[:, None] * axes
    norm = np.linalg.norm(across, axis=1)
    along = norm < 1e-6 * np.linalg.norm(vectors, axis=1)
    if along.any():
        least = np.argmin(np.abs(axes[along]), axis=1)
        across[along] = np.cross(axes[along], np.eye(3)[least])
    return np.asarray(across / np.linalg.norm(across, axis=1)[:, None])
