"""Fit the confidences of mode `canopy` to scans whose truth is known."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from canopy_skel.assemble import free_ends
from canopy_skel.canopy import CanopyScan, map_cost, vertex_features
from canopy_skel.confidence import Depth, Logistic, Models, fit_logistic
from canopy_skel.document import SkeletonDocument
from canopy_skel.extend import rays_of
from canopy_skel.fusion import Observed
from canopy_skel.geometry import BoolArray, FloatArray
from canopy_skel.likelihood import LikelihoodMap
from canopy_skel.links import Candidates, Parts, candidates_of, links_to_make, places_on
from canopy_skel.metrics.calibration import expected_calibration_error

POINT_M = 0.015
RIGHT_M = 0.02
LINK_SHARE = 0.8


@dataclass(frozen=True, kw_only=True, eq=False, slots=True)
class Lesson:
    """One scan with its truth: positions on the true curve, a millimetre or so apart.

    depth: where that of its views comes from.
    """

    scan: CanopyScan
    likelihood: LikelihoodMap
    truth: cKDTree
    depth: Depth

    def cost(self, points: FloatArray) -> FloatArray:
        """Return -log p of the likelihood map at points (N, 3)."""
        return map_cost(self.likelihood, points)

    def right(self, points: FloatArray, within_m: float) -> BoolArray:
        """Say which points (N, 3) have truth within a distance."""
        if len(points) == 0:
            return np.zeros(0, dtype=np.bool_)
        return np.asarray(self.truth.query(points)[0] <= within_m)


def truth_points(truth: SkeletonDocument) -> cKDTree:
    """Return the true curve as points, edges cut into eight."""
    start, end = truth.position[truth.edges.T]
    cuts = [start + (end - start) * k / 8 for k in range(9)]
    return cKDTree(np.concatenate(cuts))


def fit_models(lessons: Sequence[Lesson], provenance: str) -> Models:
    """Fit all models, each on what the ones before it let through."""
    models = Models(
        instance_point=_fit(_points(lesson, fragments=False) for lesson in lessons),
        fragment_point=_fit(_points(lesson, fragments=True) for lesson in lessons),
        vertex=_CERTAIN,
        link=_CERTAIN,
        joint=_CERTAIN,
        extension=_CERTAIN,
        provenance=provenance,
    )
    fused = [(lesson, lesson.scan.observed(models)[0]) for lesson in lessons]
    models = replace(models, vertex=_fit(_vertices(*pair, models) for pair in fused))
    stages = [_stage(*pair, models) for pair in fused]
    for name, rows in _JOINING.items():
        model = _fit(rows(stage, models) for stage in stages)
        models = replace(models, **{name: model})  # type: ignore[arg-type]  # names of models
    return models


def reliability(lesson: Lesson, models: Models) -> dict[str, float]:
    """Return the expected calibration error of each model on a scan (0 where it asks nothing)."""
    fused, _ = lesson.scan.observed(models)
    stage = _stage(lesson, fused, models)
    questions = {
        "instance_point": _points(lesson, fragments=False),
        "fragment_point": _points(lesson, fragments=True),
        "vertex": _vertices(lesson, fused, models),
        **{name: rows(stage, models) for name, rows in _JOINING.items()},
    }
    errors = {}
    for name, (features, right) in questions.items():
        error = expected_calibration_error(
            getattr(models, name)(features), right, np.ones(len(right))
        )
        errors[name] = error or 0.0
    return errors


@dataclass(frozen=True, kw_only=True, eq=False, slots=True)
class _Stage:
    """What is to be joined in a scan, and the links worth asking about."""

    lesson: Lesson
    parts: Parts
    found: Candidates


Rows = tuple[FloatArray, BoolArray]
"""Features (N, F), and which rows are right (N,)."""
_CERTAIN = Logistic(bias=5.0, linear=(), products=(), means=(), scales=())


def _stage(lesson: Lesson, fused: Observed, models: Models) -> _Stage:
    scan = lesson.scan
    parts, _ = scan.parts(fused, models)
    found = candidates_of(parts, scan.evidence, lesson.cost, scan.config.links)
    return _Stage(lesson=lesson, parts=parts, found=found)


def _fit(rows: Iterable[Rows]) -> Logistic:
    pairs = list(rows)
    return fit_logistic(
        np.concatenate([features for features, _ in pairs]),
        np.concatenate([right for _, right in pairs]),
    )


def _points(lesson: Lesson, *, fragments: bool) -> Rows:
    points, _, _, fragment, _, features = lesson.scan.points()
    chosen = fragment == fragments
    return features[chosen], lesson.right(points[chosen], POINT_M)


def _vertices(lesson: Lesson, fused: Observed, models: Models) -> Rows:
    parts, observed = lesson.scan.parts(fused, models)
    return vertex_features(observed, parts.length_m), lesson.right(parts.points, RIGHT_M)


def _links(stage: _Stage, _: Models) -> Rows:
    curves = stage.found.curves
    right = stage.lesson.right(curves.reshape(-1, 3), RIGHT_M).reshape(curves.shape[:2])
    return stage.found.features, right[:, 1:-1].mean(axis=1) >= LINK_SHARE


def _joints(stage: _Stage, models: Models) -> Rows:
    config = stage.lesson.scan.config.links
    probability = models.link(stage.found.features)
    made = links_to_make(stage.parts, stage.found, probability, config)
    places = places_on(stage.found, made, probability, config.spacing_m)
    return places.features, stage.lesson.right(places.points, RIGHT_M)


def _extensions(stage: _Stage, models: Models) -> Rows:
    lesson, parts, found, scan = stage.lesson, stage.parts, stage.found, stage.lesson.scan
    made = links_to_make(parts, found, models.link(found.features), scan.config.links)
    free = free_ends(parts, found, made)
    rays = rays_of(parts, free, scan.evidence, lesson.cost, scan.config.extensions)
    right = lesson.right(rays.points.reshape(-1, 3), RIGHT_M).reshape(rays.open.shape)
    return rays.features[rays.open], right[rays.open]


_JOINING: dict[str, Callable[[_Stage, Models], Rows]] = {
    "link": _links,
    "joint": _joints,
    "extension": _extensions,
}
