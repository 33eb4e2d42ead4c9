"""Fit the confidences of mode `canopy` to scans whose truth is known."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from scipy.spatial import cKDTree

from canopy_skel.assemble import free_ends
from canopy_skel.canopy import CanopyScan, map_cost, vertex_features
from canopy_skel.confidence import Logistic, Models, fit_logistic
from canopy_skel.document import SkeletonDocument
from canopy_skel.extend import rays_of
from canopy_skel.fusion import Observed
from canopy_skel.geometry import BoolArray, FloatArray
from canopy_skel.likelihood import LikelihoodMap
from canopy_skel.links import Candidates, Parts, accepted, candidates_of
from canopy_skel.metrics.calibration import expected_calibration_error

POINT_M = 0.015
RIGHT_M = 0.02
LINK_SHARE = 0.8


@dataclass(frozen=True, kw_only=True, eq=False, slots=True)
class Lesson:
    """One scan with its truth: positions on the true curve, a millimetre or so apart."""

    scan: CanopyScan
    likelihood: LikelihoodMap
    truth: cKDTree

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
        instance_point=_fit(lessons, lambda lesson: _points(lesson, fragments=False)),
        fragment_point=_fit(lessons, lambda lesson: _points(lesson, fragments=True)),
        vertex=_CERTAIN,
        link=_CERTAIN,
        extension=_CERTAIN,
        provenance=provenance,
    )
    for name, rows in _LATER.items():
        model = _fit(lessons, partial(_asked, rows, models))
        models = replace(models, **{name: model})  # type: ignore[arg-type]  # names of models
    return models


def reliability(lesson: Lesson, models: Models) -> dict[str, float]:
    """Return the expected calibration error of each model on a scan (0 where it asks nothing)."""
    errors = {}
    questions: dict[str, Rows] = {
        "instance_point": lambda lesson, _: _points(lesson, fragments=False),
        "fragment_point": lambda lesson, _: _points(lesson, fragments=True),
        **_LATER,
    }
    for name, rows in questions.items():
        features, right = rows(lesson, models)
        error = expected_calibration_error(
            getattr(models, name)(features), right, np.ones(len(right))
        )
        errors[name] = error or 0.0
    return errors


Rows = Callable[[Lesson, Models], tuple[FloatArray, BoolArray]]
_CERTAIN = Logistic(bias=5.0, weights=(), means=(), scales=())


def _asked(rows: Rows, models: Models, lesson: Lesson) -> tuple[FloatArray, BoolArray]:
    return rows(lesson, models)


def _fit(
    lessons: Sequence[Lesson], rows: Callable[[Lesson], tuple[FloatArray, BoolArray]]
) -> Logistic:
    pairs = [rows(lesson) for lesson in lessons]
    return fit_logistic(
        np.concatenate([features for features, _ in pairs]),
        np.concatenate([right for _, right in pairs]),
    )


def _points(lesson: Lesson, *, fragments: bool) -> tuple[FloatArray, BoolArray]:
    points, _, _, fragment, _, features = lesson.scan.points()
    chosen = fragment == fragments
    return features[chosen], lesson.right(points[chosen], POINT_M)


def _parts(lesson: Lesson, models: Models) -> tuple[Parts, Observed]:
    return lesson.scan.parts(lesson.scan.observed(models)[0], models)


def _vertices(lesson: Lesson, models: Models) -> tuple[FloatArray, BoolArray]:
    parts, observed = _parts(lesson, models)
    return vertex_features(observed, parts.length_m), lesson.right(parts.points, RIGHT_M)


def _links(lesson: Lesson, models: Models) -> tuple[FloatArray, BoolArray]:
    parts, _ = _parts(lesson, models)
    found = _candidates(lesson, parts)
    right = lesson.right(found.curves.reshape(-1, 3), RIGHT_M).reshape(found.curves.shape[:2])
    return found.features, right[:, 1:-1].mean(axis=1) >= LINK_SHARE


def _extensions(lesson: Lesson, models: Models) -> tuple[FloatArray, BoolArray]:
    scan, (parts, _) = lesson.scan, _parts(lesson, models)
    found = _candidates(lesson, parts)
    made = accepted(
        found,
        models.link(found.features),
        parts.component,
        parts.component[parts.ends.vertex],
        scan.config.links.min_probability,
    )
    free = free_ends(parts, found, made)
    rays = rays_of(parts, free, scan.evidence, lesson.cost, scan.config.extensions)
    right = lesson.right(rays.points.reshape(-1, 3), RIGHT_M).reshape(rays.open.shape)
    return rays.features[rays.open], right[rays.open]


def _candidates(lesson: Lesson, parts: Parts) -> Candidates:
    scan = lesson.scan
    return candidates_of(parts, scan.evidence, lesson.cost, scan.config.links)


_LATER: dict[str, Rows] = {"vertex": _vertices, "link": _links, "extension": _extensions}
