"""One view in mode `canopy`: points on the wood it shows, and what it says of other points."""

from dataclasses import dataclass, replace

import numpy as np

from canopy_skel.evidence import ViewEvidence, evidence_of
from canopy_skel.frame import Float32Array, View
from canopy_skel.geometry import BoolArray, FloatArray, IntArray, invert, transform_points
from canopy_skel.kernels import agree, fuse, profile
from canopy_skel.pieces import (
    Piece,
    PieceConfig,
    depth_of,
    pieces_of,
    regions_of_masks,
)
from canopy_skel.segment import BranchMask
from canopy_skel.spline import BranchSpline
from canopy_skel.wood import (
    FragmentConfig,
    fragments_of,
    mask_image,
    wood_probability,
)
from canopy_skel.woodpixels import PixelModel, shipped_pixel_model

SAMPLE_M = 0.005
_NEAR_M = 0.02
_ACROSS_M = 0.012
_MIN_COSINE = 0.82


@dataclass(frozen=True, kw_only=True, eq=False, slots=True)
class Observation:
    """What one view shows.

    splines: the instances as polylines. fragments: how many pieces there are beside them. dropped:
    instances without enough depth. points_in_base, directions: (N, 3), along the pieces; piece:
    (N,), which of them, ascending; radius_m: (N,), of the pixels, probable_radius_m: what the wood
    has, see `Piece`; fragment: (N,); quality: (N, 12), see `_quality`.
    evidence: the view, ready to be asked. cells: (N,) cell numbers ascending, of the points in the
    order `by_cell` (N,).
    """

    splines: list[BranchSpline]
    fragments: int
    dropped: tuple[int, ...]
    points_in_base: FloatArray
    directions: FloatArray
    piece: IntArray
    radius_m: FloatArray
    probable_radius_m: FloatArray
    fragment: BoolArray
    quality: FloatArray
    evidence: ViewEvidence
    cells: IntArray
    by_cell: IntArray

    def agreement(self, points_in_base: FloatArray, directions: FloatArray) -> IntArray:
        """Say of points (N, 3) of another view what this view has beside and along them (N, 3).

        Wood lies along wood in view after view; leaves taken for wood seldom do.
        """
        return agree.agreement(
            points_in_base,
            np.ascontiguousarray(directions),
            self.points_in_base[self.by_cell],
            self.directions[self.by_cell],
            self.fragment[self.by_cell],
            self.cells,
            _NEAR_M,
            _ACROSS_M,
            _NEAR_M,
            _MIN_COSINE,
        )


def moved(seen: Observation, motion: FloatArray) -> Observation:
    """Return what the view would have shown, had its camera stood elsewhere by a motion (4, 4)."""
    points = transform_points(motion, seen.points_in_base)
    cells = fuse.cell_keys(points, _NEAR_M)
    by_cell = np.argsort(cells, kind="stable")
    return replace(
        seen,
        splines=[
            replace(
                spline,
                control_points_in_base=transform_points(motion, spline.control_points_in_base),
            )
            for spline in seen.splines
        ],
        points_in_base=points,
        directions=np.ascontiguousarray(seen.directions @ motion[:3, :3].T),
        evidence=replace(
            seen.evidence,
            camera_from_base=np.ascontiguousarray(seen.evidence.camera_from_base @ invert(motion)),
        ),
        cells=cells[by_cell],
        by_cell=by_cell,
    )


def observe(
    view: View,
    masks: list[BranchMask],
    pieces_config: PieceConfig,
    fragments_config: FragmentConfig | None,
    maps: Float32Array | None = None,
    pixel_model: PixelModel | None = None,
) -> Observation:
    """Lift the masks of a view, and the fragments beside them, into base.

    maps: (8, h, w) of the network, which fragments need. pixel_model: without, the shipped one.
    `fragments_config` or `maps` None: no fragments.

    Raises:
        ViewError: the view has no depth.
    """
    regions = regions_of_masks(masks)
    pieces = pieces_of(view, regions, pieces_config, fragments=False)
    lifted = {piece.spline.instance for piece in pieces}
    wood = mask_image(view, regions)
    with np.errstate(invalid="ignore"):  # Wood of other rows says nothing of this tree's.
        wood &= ~(depth_of(view) > pieces_config.farthest_m)
    if fragments_config is not None and maps is not None:
        model = pixel_model or shipped_pixel_model()
        probability = wood_probability(view, maps, wood, fragments_config, model)
        fragments = fragments_of(probability, maps, fragments_config)
        pieces += pieces_of(view, fragments, pieces_config, fragments=True)
        wood[fragments.v, fragments.u] = True
    points, directions, of = sampled(pieces)
    cells = fuse.cell_keys(points, _NEAR_M)
    by_cell = np.argsort(cells, kind="stable")
    return Observation(
        splines=[piece.spline for piece in pieces if not piece.fragment],
        fragments=sum(piece.fragment for piece in pieces),
        dropped=tuple(mask.instance for mask in masks if mask.instance not in lifted),
        points_in_base=points,
        directions=directions,
        piece=of,
        radius_m=np.array([p.spline.radius_m for p in pieces])[of],
        probable_radius_m=np.array([p.radius_m for p in pieces])[of],
        fragment=np.array([p.fragment for p in pieces], dtype=np.bool_)[of],
        quality=_quality(pieces)[of],
        evidence=evidence_of(view, wood),
        cells=cells[by_cell],
        by_cell=by_cell,
    )


def _quality(pieces: list[Piece]) -> FloatArray:
    """Return the figures (R, 12) by which pieces are judged.

    Score, quality of the piece, log of half its area over its length; of fragments, how far the
    network's directions agree, and its logits as in `Regions`.
    """
    if not pieces:
        return np.zeros((0, 12))
    quality = np.array([piece.quality for piece in pieces])
    pixels, length_px, width_px, valid, inlier, lateral = quality.T
    pixel_m = np.array([piece.pixel_m for piece in pieces])
    cosine, sine, *logits = np.array([piece.said for piece in pieces]).T
    return np.column_stack(
        [
            [piece.spline.confidence for piece in pieces],
            np.log(pixels),
            np.log(length_px / width_px),
            np.log(width_px),
            valid,
            inlier,
            lateral,
            np.log(pixel_m * 0.5 * width_px),
            np.hypot(cosine, sine),
            *logits,
        ]
    )


def sampled(pieces: list[Piece]) -> tuple[FloatArray, FloatArray, np.ndarray]:
    """Return points every `SAMPLE_M` along the pieces, unit directions, and the piece of each."""
    lines = [piece.spline.control_points_in_base for piece in pieces]
    start = np.cumsum([0, *(len(line) for line in lines)])
    return profile.sample_lines(np.concatenate([np.zeros((0, 3)), *lines]), start, SAMPLE_M)
