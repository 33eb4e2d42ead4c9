"""From the views of a scan to one skeleton: fuse, link, extend, and say how each part is known."""

from dataclasses import dataclass, replace

import numpy as np

from canopy_skel.baselines.mst import join_by_spanning_tree
from canopy_skel.canopy import CanopyScan, map_cost
from canopy_skel.confidence import Models
from canopy_skel.extend import Rays, lengths, rays_of
from canopy_skel.fusion import Observed
from canopy_skel.geometry import FloatArray, IntArray
from canopy_skel.graph import SkeletonGraph
from canopy_skel.likelihood import LikelihoodMap
from canopy_skel.links import Candidates, Parts, Places, candidates_of, links_to_make, places_on
from canopy_skel.poses import LoneView, PoseCorrection

TAIL_CONFIDENCE = 0.1
"""Of joins that no evidence supports, made only because one tree was asked for."""
OBSERVED, FRAGMENT, LINK, EXTENSION = range(4)


@dataclass(frozen=True, kw_only=True, eq=False, slots=True)
class Assembled:
    """The skeleton, in how many parts wood was observed, views that were moved, or stand alone."""

    graph: SkeletonGraph
    observed_components: int
    corrections: tuple[PoseCorrection, ...]
    lone_views: tuple[LoneView, ...]


def skeleton_of(scan: CanopyScan, likelihood: LikelihoodMap, models: Models) -> Assembled:
    """Return the skeleton of all views so far."""
    fused, corrections = scan.observed(models)
    parts, observed = scan.parts(fused, models)
    config = scan.config

    def cost(points: FloatArray) -> FloatArray:
        return map_cost(likelihood, points)

    candidates = candidates_of(parts, scan.evidence, cost, config.links)
    probability = models.link(candidates.features)
    made = links_to_make(parts, candidates, probability, config.links)
    places = places_on(candidates, made, probability, config.links.spacing_m)
    free = free_ends(parts, candidates, made)
    rays = rays_of(parts, free, scan.evidence, cost, config.extensions)
    steps = extension_probability(models, rays)
    graph = _observed_graph(parts, observed)
    graph = with_links(graph, candidates, made, places, models.joint(places.features), parts)
    graph = with_extensions(
        graph, rays, lengths(rays, parts, steps, config.extensions), steps, parts
    )
    if config.rooted:
        graph = with_tail(graph, config.links.spacing_m)
    return Assembled(
        graph=graph,
        observed_components=int(parts.component.max(initial=-1)) + 1,
        corrections=tuple(corrections),
        lone_views=tuple(scan.lone_views()),
    )


def free_ends(parts: Parts, candidates: Candidates, made: IntArray) -> IntArray:
    """Return the ends that no link uses."""
    used = np.concatenate([candidates.end[made], candidates.other[made]])
    return np.setdiff1d(np.arange(len(parts.ends.vertex)), used)


def extension_probability(models: Models, rays: Rays) -> FloatArray:
    """Return the probability of each step (K, n): never more than that of the step before."""
    shape = rays.features.shape
    each = models.extension(rays.features.reshape(-1, shape[2])).reshape(shape[:2])
    return np.minimum.accumulate(each, axis=1)


def _observed_graph(parts: Parts, observed: Observed) -> SkeletonGraph:
    source = np.where(parts.fragment, FRAGMENT, OBSERVED)
    return SkeletonGraph(
        vertices_in_base=parts.points,
        edges=observed.edges,
        radius_m=parts.probable_radius_m,
        occluded=np.zeros(len(source), dtype=np.bool_),
        confidence=parts.confidence,
        source=source.astype(np.int64),
    )


def with_links(
    graph: SkeletonGraph,
    candidates: Candidates,
    made: IntArray,
    places: Places,
    confidence: FloatArray,
    parts: Parts,
) -> SkeletonGraph:
    """Add links as chains of vertices at their places, as thick as the thinner of their ends."""
    chains = []
    for k, i in enumerate(made.tolist()):
        a, b = int(parts.ends.vertex[candidates.end[i]]), int(candidates.vertex[i])
        own = slice(places.first[k], places.first[k + 1])
        chains.append(
            Chain(
                start=a,
                goal=b,
                points=places.points[own],
                radius_m=min(graph.radius_m[a], graph.radius_m[b]),
                confidence=confidence[own],
                source=LINK,
            )
        )
    return with_chains(graph, chains)


def with_extensions(
    graph: SkeletonGraph, rays: Rays, steps: IntArray, probability: FloatArray, parts: Parts
) -> SkeletonGraph:
    """Add extensions as chains of vertices."""
    chains = []
    for k in np.flatnonzero(steps).tolist():
        start = int(parts.ends.vertex[rays.end[k]])
        chains.append(
            Chain(
                start=start,
                goal=-1,
                points=rays.points[k, : steps[k]],
                radius_m=float(graph.radius_m[start]),
                confidence=probability[k, : steps[k]],
                source=EXTENSION,
            )
        )
    return with_chains(graph, chains)


def with_tail(graph: SkeletonGraph, spacing_m: float) -> SkeletonGraph:
    """Join what is left apart by the shortest straight gaps, with a confidence that warns."""
    joined = join_by_spanning_tree(replace(graph, source=None), spacing_m)
    added = len(joined.vertices_in_base) - len(graph.vertices_in_base)
    confidence = joined.confidence.copy()
    confidence[len(confidence) - added :] = TAIL_CONFIDENCE
    source = np.append(sources_of(graph), np.full(added, LINK))
    return replace(joined, confidence=confidence, source=source)


@dataclass(frozen=True, kw_only=True, eq=False, slots=True)
class Chain:
    """New vertices (n, 3) in a row from vertex `start` to `goal` (-1: to nowhere)."""

    start: int
    goal: int
    points: FloatArray
    radius_m: float
    confidence: FloatArray
    source: int


def with_chains(graph: SkeletonGraph, chains: list[Chain]) -> SkeletonGraph:
    """Add predicted vertices in rows."""
    if not chains:
        return graph
    count, edges = len(graph.vertices_in_base), [graph.edges]
    for chain in chains:
        row = [chain.start, *range(count, count + len(chain.points))]
        row += [chain.goal] if chain.goal >= 0 else []
        edges.append(np.column_stack([row[:-1], row[1:]]).astype(np.int64))
        count += len(chain.points)
    sizes = [len(chain.points) for chain in chains]
    added = sum(sizes)
    return SkeletonGraph(
        vertices_in_base=np.concatenate([graph.vertices_in_base, *(c.points for c in chains)]),
        edges=np.concatenate(edges),
        radius_m=np.append(graph.radius_m, np.repeat([c.radius_m for c in chains], sizes)),
        occluded=np.append(graph.occluded, np.ones(added, dtype=np.bool_)),
        confidence=np.concatenate([graph.confidence, *(c.confidence for c in chains)]),
        source=np.append(
            sources_of(graph),
            np.repeat(np.array([c.source for c in chains], dtype=np.int64), sizes),
        ),
    )


def sources_of(graph: SkeletonGraph) -> IntArray:
    """Return how each vertex is known (V,); observed where nobody says."""
    if graph.source is None:
        return np.zeros(len(graph.vertices_in_base), dtype=np.int64)
    return graph.source
