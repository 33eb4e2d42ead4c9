"""Recordings with truth, made ready to fit confidences to."""

from collections.abc import Sequence
from pathlib import Path

from scipy.spatial import cKDTree

from canopy_skel.canopy import CanopyConfig, CanopyScan
from canopy_skel.confidence import Depth, Models, ModelSets
from canopy_skel.document import from_json
from canopy_skel.errors import RecordingError, UsageError
from canopy_skel.fitting import Lesson, fit_models, truth_points
from canopy_skel.frame import View
from canopy_skel.likelihood import LikelihoodConfig, LikelihoodMap, segments_of
from canopy_skel.pipeline import MethodConfig
from canopy_skel.recording import read_recording
from canopy_skel.segmenters.mapping import WithMaps
from canopy_skel.woodpixels import PixelModel, shipped_pixel_model
from drivers.stereo import with_depth
from service.experiment.segmenters import segmenter_named
from service.pixellessons import pixel_model_of


def pixel_models_without(
    paths: Sequence[Path], more: Sequence[Path] = ()
) -> dict[Path, PixelModel | None]:
    """Return for each recording a model of wood pixels that was fitted to other trees.

    A model knows the trees it was fitted to better than others, and confidences learned there would
    promise too much. Of a tree that the shipped model was not fitted to: None, the shipped model.
    The other trees, those of `more` with them, are dealt out in two halves, each with a model
    fitted to the other half; a tree is known by the name of its recordings without the foliage.

    Raises:
        RecordingError: one cannot be read, or has no truth.
        UsageError: all that the shipped model was fitted to is one tree.
    """
    known = {_tree(name) for name in shipped_pixel_model().fitted_to}
    seen = [path for path in paths if _tree(path.stem) in known]
    result: dict[Path, PixelModel | None] = dict.fromkeys(paths)
    if not seen:
        return result
    every = sorted({*seen, *more})
    trees = sorted({_tree(path.stem) for path in every})
    if len(trees) < 2:
        raise UsageError(
            f"the shipped model of wood pixels was fitted to {trees[0]}, the only tree of its own"
            " here; give another of those with --pixels"
        )
    halves = [[path for path in every if trees.index(_tree(path.stem)) % 2 == k] for k in (0, 1)]
    models = [pixel_model_of(half, ("recorded",)) for half in halves]
    return result | {path: models[1 - trees.index(_tree(path.stem)) % 2] for path in seen}


def _tree(name: str) -> str:
    """Return species and topology, which names of simulated scans begin with."""
    return "_".join(name.split("_")[:2])


def lesson_from(
    path: Path,
    segmenter: str,
    *,
    use_fragments: bool = True,
    pixel_model: PixelModel | None = None,
) -> Lesson:
    """Read a recording and take all its views in; wood pixels by the shipped model, or by this.

    Raises:
        RecordingError: it cannot be read, or has no truth.
        UsageError: there is no such segmenter.
    """
    views, truth = _views_and_truth(path)
    return _lesson(views, truth, segmenter, use_fragments, pixel_model)


def lessons_from(
    path: Path, masks: Sequence[str], pixel_model: PixelModel | None = None
) -> list[Lesson]:
    """Read a recording with each kind of masks, and with the first once more without fragments.

    Raises: as `lesson_from`.
    """
    views, truth = _views_and_truth(path)
    without = _lesson(views, truth, masks[0], False, None)
    return [without, *(_lesson(views, truth, name, True, pixel_model) for name in masks)]


def _views_and_truth(path: Path) -> tuple[list[View], cKDTree]:
    recording = read_recording(path)
    if recording.ground_truth is None:
        raise RecordingError(
            f"{path}: no true skeleton is attached; record it with canopy simulate"
        )
    views = [with_depth(view) for view in recording.views() if isinstance(view, View)]
    return views, truth_points(from_json(recording.ground_truth, str(path)))


def _lesson(
    views: Sequence[View],
    truth: cKDTree,
    segmenter: str,
    use_fragments: bool,
    pixel_model: PixelModel | None,
) -> Lesson:
    finder = WithMaps(segmenter_named(segmenter))
    scan = CanopyScan(CanopyConfig(use_fragments=use_fragments), pixel_model)
    likelihood = LikelihoodMap(LikelihoodConfig())
    for view in views:
        seen = scan.observe(view, *finder.segment_and_map(view))
        likelihood.add(segments_of(seen.splines))
        scan.add(view.index, seen)
    depth: Depth = "stereo" if any(view.matched for view in views) else "camera"
    return Lesson(scan=scan, likelihood=likelihood, truth=truth, depth=depth)


def fitted(
    lessons: Sequence[Sequence[Lesson]], names: Sequence[str], masks: Sequence[str]
) -> ModelSets:
    """Fit to the `lessons_from` each scan; the first kind of masks are the recorded ones.

    Where no scan has one kind of depth, its models are fitted to the scans of the other.
    """
    settings = MethodConfig(name="canopy").sha256()[:12]

    def fit(kinds: Sequence[str], depth: Depth) -> Models:
        chosen = [k for k, scan in enumerate(lessons) if scan[0].depth == depth]
        chosen = chosen or list(range(len(lessons)))
        return fit_models(
            [lesson for k in chosen for lesson in lessons[k][: len(kinds) + 1]],
            f"fitted to {len(chosen)} scans (masks {', '.join(kinds)}; settings {settings}):"
            f" {', '.join(names[k] for k in chosen)}",
        )

    def both(kinds: Sequence[str]) -> dict[Depth, Models]:
        return {"camera": fit(kinds, "camera"), "stereo": fit(kinds, "stereo")}

    return {"recorded": both(masks[:1]), "learned": both(masks)}
