"""Fit the confidences of mode `canopy` to scans whose truth is known."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from canopy_skel.assemble import extension_probability, free_ends
from canopy_skel.canopy import CanopyScan, map_cost, vertex_features
from canopy_skel.confidence import Logistic, Models, fit_logistic
from canopy_skel.document import SkeletonDocument
from canopy_skel.extend import rays_of
from canopy_skel.geometry import BoolArray, FloatArray
from canopy_skel.likelihood import LikelihoodMap
from canopy_skel.links import accepted, candidates_of

POINT_M = 0.015
RIGHT_M = 0.02
LINK_SHARE = 0.8


@dataclass(frozen=True, kw_only=True, eq=False, slots=True)
class Lesson:
    """One scan with its truth: positions on the true curve, a millimetre or so apart."""

    scan: CanopyScan
    likelihood: LikelihoodMap
    truth: cKDTree

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
    instance, fragment = (
        _fit(lessons, lambda lesson, f=f: _points(lesson, f)) for f in (False, True)
    )
    models = Models(
        instance_point=instance,
        fragment_point=fragment,
        vertex=_CERTAIN,
        link=_CERTAIN,
        extension=_CERTAIN,
        provenance=provenance,
    )
    from dataclasses import replace

    models = replace(models, vertex=_fit(lessons, lambda lesson: _vertices(lesson, models)))
    models = replace(models, link=_fit(lessons, lambda lesson: _links(lesson, models)))
    return replace(models, extension=_fit(lessons, lambda lesson: _extensions(lesson, models)))


_CERTAIN = Logistic(bias=5.0, weights=(), means=(), scales=())


def _fit(
    lessons: Sequence[Lesson], rows: Callable[[Lesson], tuple[FloatArray, BoolArray]]
) -> Logistic:
    pairs = [rows(lesson) for lesson in lessons]
    return fit_logistic(
        np.concatenate([features for features, _ in pairs]),
        np.concatenate([right for _, right in pairs]),
    )


def _points(lesson: Lesson, fragments: bool) -> tuple[FloatArray, BoolArray]:
    points, _, _, fragment, _, features = lesson.scan.points()
    chosen = fragment == fragments
    return features[chosen], lesson.right(points[chosen], POINT_M)


def _vertices(lesson: Lesson, models: Models) -> tuple[FloatArray, BoolArray]:
    observed = lesson.scan.observed(models)
    parts, observed = lesson.scan.parts(observed, models)
    return vertex_features(observed, parts.length_m), lesson.right(parts.points, RIGHT_M)


def _links(lesson: Lesson, models: Models) -> tuple[FloatArray, BoolArray]:
    parts, _ = lesson.scan.parts(lesson.scan.observed(models), models)
    found = candidates_of(
        parts, lesson.scan.evidence, lambda x: map_cost(lesson.likelihood, x), lesson.scan.config.links
    )
    right = lesson.right(found.curves.reshape(-1, 3), RIGHT_M).reshape(found.curves.shape[:2])
    return found.features, right[:, 1:-1].mean(axis=1) >= LINK_SHARE


def _extensions(lesson: Lesson, models: Models) -> tuple[FloatArray, BoolArray]:
    scan = lesson.scan
    parts, _ = scan.parts(scan.observed(models), models)

    def cost(points: FloatArray) -> FloatArray:
        return map_cost(lesson.likelihood, points)

    found = candidates_of(parts, scan.evidence, cost, scan.config.links)
    made = accepted(
        found,
        models.link(found.features),
        parts.component,
        parts.component[parts.ends.vertex],
        scan.config.links.min_probability,
    )
    rays = rays_of(parts, free_ends(parts, found, made), scan.evidence, cost, scan.config.extensions)
    right = lesson.right(rays.points.reshape(-1, 3), RIGHT_M).reshape(rays.open.shape)
    return rays.features[rays.open], right[rays.open]
