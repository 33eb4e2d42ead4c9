"""Where a skeleton starts: the lowest thick end near the expected trunk."""

import numpy as np

from canopy_skel.geometry import FloatArray, IntArray
from canopy_skel.graph import SkeletonGraph

# The radius of an end is the median over this much of its wood: one bad fit is no trunk.
_END_M = 0.10


def main_root(graph: SkeletonGraph) -> int:
    """Return the vertex the tree grows from; z is up.

    Every end, and every valley, scores: its radius over the radius of thick wood here (at most
    1), plus its
    component's share of all wood, minus its height, minus its horizontal distance from the
    wood's centre of mass (where the trunk is expected), both over the size of the skeleton. So
    neither a low twig, nor a thick limb cut off high up, nor a weed beside the trunk wins.
    """
    points = graph.vertices_in_base
    size_m = float(np.ptp(points, axis=0).max()) or 1.0
    thick_m = float(np.percentile(graph.radius_m, 95)) or 1.0
    mass = graph.radius_m**2 if graph.radius_m.any() else np.ones(len(points))
    centre = (mass @ points[:, :2]) / mass.sum()
    ends = _starts(graph)
    thickness = np.minimum(_end_radius_m(graph, ends) / thick_m, 1.0)
    height = (points[ends, 2] - points[:, 2].min()) / size_m
    offset = np.linalg.norm(points[ends, :2] - centre, axis=1) / size_m
    score = thickness + _share(graph)[ends] - height - offset
    return int(ends[np.argmax(score)])


def fragment_root(graph: SkeletonGraph, members: IntArray, trunk: FloatArray) -> int:
    """Return the end of an unjoined component that probably points at the tree.

    It is the end with the least distance to the trunk plus half its height: wood grows outward
    and up. The trunk (T, 3), root first, is thought to go on straight down below its root, so a
    piece of it that was not joined stands upright.
    """
    points = graph.vertices_in_base
    degree = np.bincount(graph.edges.ravel(), minlength=len(points))
    ends = members[degree[members] <= 1]
    apart_m = np.linalg.norm(points[ends, None, :] - trunk[None, :, :], axis=2).min(axis=1)
    below = points[ends, 2] < trunk[0, 2]
    beside_m = np.linalg.norm(points[ends, :2] - trunk[0, :2], axis=1)
    apart_m = np.where(below, np.minimum(apart_m, beside_m), apart_m)
    return int(ends[np.argmin(apart_m + 0.5 * points[ends, 2])])


def _starts(graph: SkeletonGraph) -> IntArray:
    """Return ends, and valleys: where two stems meet lowest, the trunk below was not seen."""
    degree = np.bincount(graph.edges.ravel(), minlength=len(graph.vertices_in_base))
    z = graph.vertices_in_base[:, 2]
    lowest_beside = np.full(len(z), np.inf)
    for here, there in (graph.edges.T, graph.edges.T[::-1]):
        np.minimum.at(lowest_beside, here, z[there])
    return np.flatnonzero((degree <= 1) | (lowest_beside > z))


def _share(graph: SkeletonGraph) -> FloatArray:
    """Return for each vertex the part of all wood, by length, that its component holds."""
    count, label = graph.components()
    start, end = graph.vertices_in_base[graph.edges.T]
    length_m = np.linalg.norm(end - start, axis=1)
    wood_m = np.bincount(label[graph.edges[:, 0]], weights=length_m, minlength=count)
    return wood_m[label] / (wood_m.sum() or 1.0)


def _end_radius_m(graph: SkeletonGraph, ends: IntArray) -> FloatArray:
    """Return for each end the median radius of its wood, at most up to the next fork."""
    neighbours: list[list[int]] = [[] for _ in graph.vertices_in_base]
    for a, b in graph.edges.tolist():
        neighbours[a].append(b)
        neighbours[b].append(a)
    points = graph.vertices_in_base
    radii = []
    for end in ends.tolist():
        path = [end]
        onward = neighbours[end]
        while len(onward) == 1 and np.linalg.norm(points[path[-1]] - points[end]) < _END_M:
            came, here = path[-1], onward[0]
            path.append(here)
            onward = [v for v in neighbours[here] if v != came]
        beside = neighbours[end] if len(neighbours[end]) > 1 else []
        radii.append(float(np.median(graph.radius_m[[*path, *beside]])))
    return np.array(radii)
