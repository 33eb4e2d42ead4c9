"""Recordings with truth, made ready to fit the model of wood pixels to."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from canopy_skel.canopy import CanopyConfig
from canopy_skel.document import SkeletonDocument, from_json
from canopy_skel.errors import RecordingError
from canopy_skel.frame import Float32Array, View
from canopy_skel.geometry import BoolArray, FloatArray, transform_points
from canopy_skel.pieces import depth_of, regions_of_masks
from canopy_skel.recording import read_recording
from canopy_skel.segmenters.mapping import WithMaps
from canopy_skel.wood import asked_pixels, colour_log_odds, mask_image
from canopy_skel.woodpixels import PixelModel, figures_of, hints_of, lab_of, layers_of
from service.experiment.segmenters import segmenter_named
from service.pixelfit import fit_pixels

_WITHIN_M = 0.012
_BESIDE_M = 0.006
_WOOD_SHARE, _OTHER_SHARE = 0.5, 0.1
"""What is learned from of the pixels that are wood, and of those that are not, which are many."""


@dataclass(frozen=True, kw_only=True, eq=False, slots=True)
class Pixels:
    """What lies around pixels (N, FIGURES), whether they show wood (N,), their weight (N,)."""

    figures: Float32Array
    wood: BoolArray
    weights: Float32Array


def pixel_model_of(paths: Sequence[Path], masks: Sequence[str]) -> PixelModel | None:
    """Fit the model to recordings with truth, with each kind of masks; None if none has depth.

    Views whose depth has to be matched from stereo pairs are left out: with a quarter of such scans
    the precision of five others fell by .01.

    Raises:
        RecordingError: one cannot be read, or has no truth.
        UsageError: there is no such segmenter.
    """
    lessons = [pixels for path in sorted(paths) for name in masks for pixels in _of(path, name)]
    if not lessons:
        return None
    return fit_pixels(
        np.concatenate([one.figures for one in lessons]),
        np.concatenate([one.wood for one in lessons]),
        np.concatenate([one.weights for one in lessons]),
        f"fitted to {len(paths)} scans (masks {', '.join(masks)}):"
        f" {', '.join(path.stem for path in sorted(paths))}",
    )


def _of(path: Path, masks: str) -> list[Pixels]:
    finder = WithMaps(segmenter_named(masks))
    recording = read_recording(path)
    if recording.ground_truth is None:
        raise RecordingError(
            f"{path}: no true skeleton is attached; record it with canopy simulate"
        )
    tree, radius_m = _truth(from_json(recording.ground_truth, str(path)))
    return [
        _pixels(view, finder, tree, radius_m)
        for view in recording.views()
        if isinstance(view, View) and view.depth_m is not None
    ]


def _truth(truth: SkeletonDocument) -> tuple[cKDTree, FloatArray]:
    start, end = truth.edges.T
    at = np.linspace(0.0, 1.0, 9)[:, None, None]
    points = (1 - at) * truth.position[start] + at * truth.position[end]
    radius_m = (1 - at[..., 0]) * truth.radius[start] + at[..., 0] * truth.radius[end]
    return cKDTree(points.reshape(-1, 3)), radius_m.ravel()


def _pixels(view: View, finder: WithMaps, tree: cKDTree, radius_m: FloatArray) -> Pixels:
    settings = CanopyConfig()
    # From what is never asked, too: it shows best what wood does not look like.
    everywhere = replace(settings.fragments, min_logit_around=-np.inf)
    depth_m = depth_of(view)
    masks, maps = finder.segment_and_map(view)
    covered = mask_image(view, regions_of_masks(masks))
    covered &= ~(depth_m > settings.pieces.farthest_m)
    lab = lab_of(view)
    log_odds, mean_odds = colour_log_odds(view, lab, covered, settings.fragments)
    hints = hints_of(maps)
    v, u = asked_pixels(mean_odds, hints, everywhere)
    surface = view.intrinsics.back_project(
        u.astype(np.float64), v.astype(np.float64), depth_m[v, u].astype(np.float64)
    )
    distance_m, nearest = tree.query(transform_points(view.base_from_camera, surface))
    wood = distance_m <= np.maximum(_WITHIN_M, radius_m[nearest] + _BESIDE_M)
    shares = np.where(wood, _WOOD_SHARE, _OTHER_SHARE)
    drawn = np.random.default_rng(view.index).random(len(v)) < shares
    v, u, wood, shares = v[drawn], u[drawn], wood[drawn], shares[drawn]
    layers = layers_of(view, lab, covered, log_odds)
    return Pixels(
        figures=figures_of(layers, hints, mean_odds[v, u], v, u),
        wood=wood,
        weights=(1.0 / shares).astype(np.float32),
    )
