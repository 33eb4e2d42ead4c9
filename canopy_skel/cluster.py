"""Mask x depth -> slender 3-D point clusters (paper III-B), filtered for real depth cameras."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from canopy_skel.errors import UsageError, ViewError
from canopy_skel.frame import Float32Array, Intrinsics, View
from canopy_skel.geometry import BoolArray, FloatArray, IntArray, transform_points
from canopy_skel.kernels import parts, trust
from canopy_skel.kernels import strip as outline
from canopy_skel.segment import BranchMask

THICKEST_M = 0.15
"""Radius of wood. What is thicker is a false mask, and would take up the likelihood map."""
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
    split; parts under `min_points` are dropped, those whose second principal deviation exceeds
    `max_flatness` of the first (blobs are not branches), and those thicker than `THICKEST_M`.
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

    def __post_init__(self) -> None:
        """Refuse ranges that are none."""
        require_range(self.nearest_m, self.farthest_m)
        require_above_0("tolerance_m", self.tolerance_m)
        require_above_0("connect_m", self.connect_m)


def require_range(nearest_m: float, farthest_m: float) -> None:
    """Check a range of depth: 0 stands for no depth at all.

    Raises:
        UsageError: it is empty, or begins at the camera.
    """
    if not 0.0 < nearest_m < farthest_m:
        raise UsageError(
            f"depth from {nearest_m} m to {farthest_m} m: give a nearest above 0 (no depth) and"
            " below the farthest"
        )


def require_above_0(name: str, length_m: float) -> None:
    """Check a length that is divided by.

    Raises:
        UsageError: it is none.
    """
    if not length_m > 0.0:
        raise UsageError(f"{name} {length_m} m: give a length above 0")


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


class UsablePixels(NamedTuple):
    """Pixels (N, 3) of u, v and depth; those of mask i from start[i] up to start[i + 1].

    sizes: (M,) how many pixels there are with those without depth.
    """

    pixels: FloatArray
    start: IntArray
    sizes: IntArray


@dataclass(frozen=True, kw_only=True, eq=False, slots=True)
class _Trusted:
    """Points (N, 3), those of mask i from start[i] up to start[i + 1], and of each mask (M,).

    enough: whether it has points.
    """

    points_in_camera: FloatArray
    start: IntArray
    enough: BoolArray


@dataclass(frozen=True, kw_only=True, eq=False, slots=True)
class _Parts:
    """Points (N, 3) part by part, and of each part (P,) its mask, flatness and median depth."""

    points_in_camera: FloatArray
    start: IntArray
    mask: IntArray
    flatness: FloatArray
    depth_m: FloatArray


def cluster_branches(
    view: View, masks: Iterable[BranchMask], config: ClusterConfig
) -> tuple[list[BranchCluster], list[RejectedInstance]]:
    """Lift the masks of a view into base.

    Raises:
        ViewError: the view has no depth.
    """
    if view.depth_m is None:
        raise ViewError(f"view {view.index}: no depth; compute it from the stereo pair first")
    masks = list(masks)
    if not masks:
        return [], []
    trusted = _trusted_points(view, view.depth_m, masks, config)
    slender = _slender_parts(trusted, config)
    in_base = transform_points(view.base_from_camera, slender.points_in_camera)
    clusters, rejected = [], []
    depth_m = slender.depth_m.tolist()
    for i, mask in enumerate(masks):
        reasons = [] if trusted.enough[i] else ["too few points with trusted depth"]
        strip = np.empty(5)
        if trusted.enough[i]:
            outline.measure(mask.mask, strip)
        for part in range(*np.searchsorted(slender.mask, (i, i + 1)).tolist()):
            first, end = slender.start[part : part + 2].tolist()
            if end - first < config.min_points:
                reasons.append("part too small")
            elif slender.flatness[part] > config.max_flatness:
                reasons.append("not slender")
            elif strip[0] > view.intrinsics.fx_px:  # Nobody can say how thick that is.
                reasons.append("wider than 90 degrees")
            elif (half_m := half_width_m(strip, mask, depth_m[part], view.intrinsics)) > THICKEST_M:
                reasons.append("thicker than a branch")
            else:
                clusters.append(
                    BranchCluster(
                        view_index=view.index,
                        instance=mask.instance,
                        confidence=mask.confidence,
                        half_width_m=half_m,
                        camera_in_base=view.base_from_camera[:3, 3],
                        points_in_base=in_base[first:end],
                    )
                )
        rejected += [
            RejectedInstance(view_index=view.index, instance=mask.instance, reason=reason)
            for reason in reasons
        ]
    return clusters, rejected


def _trusted_points(
    view: View, depth_m: Float32Array, masks: Sequence[BranchMask], config: ClusterConfig
) -> _Trusted:
    """Return the points whose depth follows the profile of their mask."""
    usable = usable_pixels(depth_m, masks, config)
    of = np.repeat(np.arange(len(masks)), np.diff(usable.start))
    follows = follow_profiles(usable, config)
    count = np.bincount(of[follows], minlength=len(masks))
    enough = count >= np.maximum(config.min_points, config.min_trusted_share * usable.sizes)
    u, v, z = usable.pixels[follows & enough[of]].T
    return _Trusted(
        points_in_camera=view.intrinsics.back_project(u, v, z),
        start=np.append(0, np.cumsum(count * enough)),
        enough=enough,
    )


def usable_pixels(
    depth_m: Float32Array, masks: Sequence[BranchMask], config: ClusterConfig
) -> UsablePixels:
    """Erode at least one mask, and take what has depth in range."""
    boxes = np.array([(m.left_px, m.top_px, *m.mask.shape) for m in masks], dtype=np.int64)
    return UsablePixels(
        *trust.pixels_of(
            np.concatenate([mask.mask.ravel() for mask in masks]),
            boxes,
            np.ascontiguousarray(depth_m, dtype=np.float32),
            config.erosion_px,
            config.min_eroded_share,
            config.nearest_m,
            config.farthest_m,
        )
    )


def half_width_m(strip: FloatArray, mask: BranchMask, depth_m: float, camera: Intrinsics) -> float:
    """Return the radius of the round wood whose outline a mask is, from `strip.measure` of it.

    The outline of a cylinder lies beside its axis, pi/4 of a radius behind its front on average.

    Args:
        strip: half width in pixels, mean pixel, direction.
        mask: what was measured.
        depth_m: of its front, the median.
        camera: that saw it.
    """
    half_px, u, v, along_u, along_v = strip.tolist()
    ray = camera.back_project(np.array([u + mask.left_px]), np.array([v + mask.top_px]), np.ones(1))
    ray = ray[0] / np.linalg.norm(ray[0])
    slant = float(ray[1] * along_u - ray[0] * along_v)
    tangent = half_px / camera.fx_px * np.sqrt(1.0 - slant**2)
    return float(depth_m * tangent / (1.0 - np.pi / 4 * tangent))


def follow_profiles(usable: UsablePixels, config: ClusterConfig) -> BoolArray:
    """Say which pixels (N,) lie on the robust profile of disparity along their mask."""
    # The same draws for all masks: none depends on what else is in the view.
    draws = np.random.default_rng(0).integers(0, 1 << 32, (config.draws, 2))
    follows: BoolArray = trust.follow_profiles(
        usable.pixels, usable.start, draws, config.tolerance_m, config.min_points
    )
    return follows


def _slender_parts(trusted: _Trusted, config: ClusterConfig) -> _Parts:
    """Split the points of each mask where they do not touch, the largest part first."""
    part, mask = parts.parts_of(trusted.points_in_camera, trusted.start, config.connect_m)
    size = np.bincount(part, minlength=len(mask))
    order = np.lexsort((-size, mask))
    rank = np.empty(len(order), dtype=np.uint16 if len(order) < 1 << 16 else np.int64)
    rank[order] = np.arange(len(order))
    points = trusted.points_in_camera[np.argsort(rank[part], kind="stable")]
    start = np.append(0, np.cumsum(size[order]))
    flatness, depth_m = parts.shapes_of(points, start).T
    return _Parts(
        points_in_camera=points, start=start, mask=mask[order], flatness=flatness, depth_m=depth_m
    )


def principal_axes(points: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return deviations (3,) in metres, descending, and unit axes as rows (3, 3) of (N, 3) points.

    The sign of each axis is canonical: its largest component is positive.
    """
    centred = points - points.mean(axis=0)
    variance, vectors = np.linalg.eigh(centred.T @ centred / len(points))
    axes = vectors.T[::-1]
    sign = np.sign(axes[np.arange(3), np.argmax(np.abs(axes), axis=1)])
    return np.sqrt(np.maximum(variance[::-1], 0.0)), axes * sign[:, None]
