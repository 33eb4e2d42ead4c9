"""The front end of mode `canopy`: regions of a picture -> polylines with radius and quality.

The centre line is fitted in the picture, where wood is sharp, and the depth along it as a robust
profile of disparity, which is linear for a straight branch whatever its slope.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from canopy_skel.cluster import FARTHEST_M, THICKEST_M, require_above_0, require_range
from canopy_skel.errors import UsageError, ViewError
from canopy_skel.frame import Float32Array, View
from canopy_skel.geometry import FloatArray, IntArray, transform_points
from canopy_skel.kernels import profile
from canopy_skel.segment import BranchMask
from canopy_skel.spline import BranchSpline

SAID = 5
"""Figures that a network says of a region, see `Regions`."""
_RIM_PX, _RADIUS_SHARE = 1.5, 0.15
_LEAST_DISPARITY = 0.05
"""Per metre, or that of twice the farthest depth: a line that runs on to less is no wood's."""
_MOST_KNOTS = 8
"""As in `kernels.profile`, which must not be compiled for settings."""


@dataclass(frozen=True, kw_only=True, slots=True)
class PieceConfig:
    """How a region becomes a polyline.

    A knot every `knot_px` along it, at most 8 for an instance and `fragment_knots` for a fragment.
    Depth counts within [nearest_m, farthest_m] (behind that are other rows) and `tolerance_m` of
    the profile (growing with the square of the distance beyond 1.25 m); a region with depth on less
    than `min_valid_share` of its pixels is dropped, and so is an instance thicker than `thickest_m`
    in radius, a fragment thicker than `thickest_fragment_m`: no branch. centre_shift: by how many
    radii the visible surface is moved away from the camera. way_px: the length of a region at which
    its own pixels say as much of its direction as a network does.
    """

    knot_px: float = 12.0
    fragment_knots: int = 3
    nearest_m: float = 0.3
    farthest_m: float = FARTHEST_M
    tolerance_m: float = 0.012
    min_valid_share: float = 0.15
    thickest_m: float = THICKEST_M
    thickest_fragment_m: float = 0.04
    centre_shift: float = np.pi / 4
    way_px: float = 60.0

    def __post_init__(self) -> None:
        """Refuse ranges that are none, and knots for which kernels have no room."""
        require_range(self.nearest_m, self.farthest_m)
        require_above_0("tolerance_m", self.tolerance_m)
        if not 2 <= self.fragment_knots <= _MOST_KNOTS or self.knot_px <= 0:
            raise UsageError(
                f"{self.fragment_knots} knots for a fragment, one every {self.knot_px} px: give"
                f" 2 to {_MOST_KNOTS}, and a distance above 0"
            )


@dataclass(frozen=True, kw_only=True, eq=False, slots=True)
class Regions:
    """Pixel sets of one view: u, v (N,); region i holds pixels start[i] up to start[i + 1].

    confidence: (R,), the segmenter's score or the mean wood probability. numbers: (R,) instance
    numbers, 0 for fragments. said: (R, 5), what a network says of their pixels: means of cos 2θ and
    sin 2θ of the direction (u right, v down) and of the logits of branch and middle line, and the
    highest of the latter; 0 without one. radius_px: (R,), what it says of their radii, NaN without.
    """

    u: IntArray
    v: IntArray
    start: IntArray
    confidence: FloatArray
    numbers: IntArray
    said: FloatArray
    radius_px: FloatArray


@dataclass(frozen=True, kw_only=True, eq=False, slots=True)
class Piece:
    """One region lifted into base: its polyline, and what tells how far to believe it.

    quality: (6,) pixels, length_px, width_px, share of pixels with depth, share of these on the
    profile, lateral deviation over width. said: (5,), see `Regions`. pixel_m: how much wood a pixel
    shows there. radius_m: what the wood probably has, by its pixels and what a network says; the
    radius of the spline is that of the pixels.
    """

    spline: BranchSpline
    fragment: bool
    radius_m: float
    pixel_m: float
    quality: FloatArray
    said: FloatArray


def regions_of_masks(masks: Sequence[BranchMask]) -> Regions:
    """Return the pixels of the masks of one view."""
    places = [np.nonzero(mask.mask) for mask in masks]
    return Regions(
        u=np.concatenate(
            [np.zeros(0, np.int64)]
            + [u + mask.left_px for (_, u), mask in zip(places, masks, strict=True)]
        ),
        v=np.concatenate(
            [np.zeros(0, np.int64)]
            + [v + mask.top_px for (v, _), mask in zip(places, masks, strict=True)]
        ),
        start=np.cumsum([0] + [len(v) for v, _ in places]),
        confidence=np.array([mask.confidence for mask in masks], dtype=np.float64),
        numbers=np.array([mask.instance for mask in masks], dtype=np.int64),
        said=np.zeros((len(masks), SAID)),
        radius_px=np.array(
            [np.nan if mask.radius_px is None else mask.radius_px for mask in masks]
        ),
    )


def pieces_of(view: View, regions: Regions, config: PieceConfig, *, fragments: bool) -> list[Piece]:
    """Lift the regions of a view into base, in their order, without those that lack depth.

    Raises:
        ViewError: the view has no depth.
    """
    depth_m = usable_depth(depth_of(view)[regions.v, regions.u], config).astype(np.float64)
    camera = view.intrinsics
    counts, knots, quality = profile.fit_regions(
        regions.u.astype(np.float64),
        regions.v.astype(np.float64),
        depth_m,
        regions.start.astype(np.int64),
        regions.said[:, :2] * (config.way_px**2 / 12),
        camera.fx_px,
        config.knot_px,
        config.fragment_knots if fragments else profile.MAX_KNOTS,
        config.tolerance_m,
        config.min_valid_share,
        min(_LEAST_DISPARITY, 0.5 / config.farthest_m),
    )
    measured_px = half_width_px(quality)
    thickest_m = config.thickest_fragment_m if fragments else config.thickest_m
    probable_px = _probable_px(measured_px, regions.radius_px, fragments=fragments)
    kept, pixel_m, points = _lifted(view, counts, knots, measured_px, thickest_m, config)
    return [
        Piece(
            spline=BranchSpline(
                view_index=view.index,
                instance=int(regions.numbers[i]),
                confidence=float(regions.confidence[i]),
                radius_m=float(measured_px[i]) * pixel,
                control_points_in_base=line[: counts[i]],
            ),
            fragment=fragments,
            radius_m=min(float(probable_px[i]) * pixel, thickest_m),
            pixel_m=pixel,
            quality=quality[i],
            said=regions.said[i],
        )
        for i, pixel, line in zip(kept.tolist(), pixel_m.tolist(), points, strict=True)
    ]


def _lifted(
    view: View,
    counts: IntArray,
    knots: FloatArray,
    radius_px: FloatArray,
    thickest_m: float,
    config: PieceConfig,
) -> tuple[IntArray, FloatArray, FloatArray]:
    """Return which regions are no thicker than a branch, their pixels in m (R,), knots in base."""
    kept = np.flatnonzero(counts)
    u, v, disparity = np.moveaxis(knots[kept], 2, 0)
    has = np.arange(knots.shape[1]) < counts[kept, None]
    mean_disparity = np.sum(disparity, axis=1, where=has) / counts[kept]
    pixel_m = 1.0 / view.intrinsics.fx_px / mean_disparity
    slender = radius_px[kept] * pixel_m <= thickest_m
    kept, pixel_m, has = kept[slender], pixel_m[slender], has[slender]
    depth_m = 1.0 / np.where(has, disparity[slender], 1.0)
    points = view.intrinsics.back_project(u[slender].ravel(), v[slender].ravel(), depth_m.ravel())
    points = points.reshape(*has.shape, 3)
    profile.shift_away(points, counts[kept], config.centre_shift * radius_px[kept] * pixel_m)
    in_base = transform_points(view.base_from_camera, points.reshape(-1, 3)).reshape(points.shape)
    return kept, pixel_m, in_base


def _probable_px(measured: FloatArray, said: FloatArray, *, fragments: bool) -> FloatArray:
    """Return the radii (R,) of regions from those of their pixels and those a network says.

    A fragment is seldom as wide as the wood it belongs to, so there the network's count. Otherwise
    the rim of what a network found is right to 1.5 pixels and its radius to 15 percent.
    """
    if fragments:
        return np.where(np.isnan(said), measured, said)
    trust = (said / _RIM_PX) ** 2
    trust /= trust + 1.0 / _RADIUS_SHARE**2
    return np.where(np.isnan(said), measured, measured**trust * said ** (1.0 - trust))


def half_width_px(quality: FloatArray) -> FloatArray:
    """Return half the width (R,) of even strips of pixels that deviate so from their middle.

    Area over length would be too thin where leaves cut pieces out of the strip.
    """
    deviation_px = quality[..., 5] * quality[..., 2]
    return np.asarray(np.sqrt(3.0 * (deviation_px**2 + 1.0 / 12.0)))


def depth_of(view: View) -> Float32Array:
    """Return the depth (H, W) of a view.

    Raises:
        ViewError: it has none.
    """
    if view.depth_m is None:
        raise ViewError(f"view {view.index}: no depth; compute it from the stereo pair first")
    return view.depth_m


def usable_depth(depth_m: Float32Array, config: PieceConfig) -> Float32Array:
    """Return the depth with NaN where it is out of range."""
    inside = (depth_m >= config.nearest_m) & (depth_m <= config.farthest_m)
    return np.where(inside, depth_m, np.float32(np.nan))
