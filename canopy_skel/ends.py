"""Free ends of a forest: where wood goes on that no view has shown."""

import math
from dataclasses import dataclass

import numpy as np

from canopy_skel.geometry import FloatArray, IntArray

TANGENT_M = 0.05
"""The tangent of an end is measured over this much of its wood."""
_SHORTEST_M = 0.02
"""With less wood than this the direction in which the views saw it is the better tangent."""


@dataclass(frozen=True, kw_only=True, eq=False, slots=True)
class Ends:
    """The free ends of a forest; a vertex without edges has two.

    vertex: (K,). tangents: (K, 3), unit, outward. behind_m: (K,) how much wood each rests on.
    """

    vertex: IntArray
    tangents: FloatArray
    behind_m: FloatArray


def find_ends(points: FloatArray, directions: FloatArray, edges: IntArray) -> Ends:
    """Return the ends of a forest over points (V, 3) with directions (V, 3), by vertex number."""
    neighbours: list[list[int]] = [[] for _ in points]
    for a, b in edges.tolist():
        neighbours[a].append(b)
        neighbours[b].append(a)
    vertex: list[int] = []
    paths: list[list[int]] = []
    behind: list[float] = []
    for v, around in enumerate(neighbours):
        if len(around) < 2:
            path, length_m = _path_from(v, neighbours, points)
            both = 1 if around else 2
            vertex += [v] * both
            paths += [path] * both
            behind += [length_m] * both
    return Ends(
        vertex=np.array(vertex, dtype=np.int64),
        tangents=_tangents(paths, behind, points, directions),
        behind_m=np.array(behind),
    )


def _path_from(
    end: int, neighbours: list[list[int]], points: FloatArray
) -> tuple[list[int], float]:
    path, length_m, onward = [end], 0.0, neighbours[end]
    while len(onward) == 1 and length_m < TANGENT_M:
        came, here = path[-1], onward[0]
        path.append(here)
        step = points[here] - points[came]
        length_m += math.sqrt(step.dot(step))
        onward = [v for v in neighbours[here] if v != came]
    return path, length_m


def _tangents(
    paths: list[list[int]], behind: list[float], points: FloatArray, directions: FloatArray
) -> FloatArray:
    """Return the outward direction (K, 3) of each path; that of a lone vertex comes twice."""
    tangents = directions[np.array([path[0] for path in paths], dtype=np.int64)]
    long = [i for i, length_m in enumerate(behind) if length_m >= _SHORTEST_M]
    spread = np.zeros((len(long), 3, 3))
    for place, i in enumerate(long):
        along = points[paths[i]]
        centred = along - np.add.reduce(along, axis=0) / len(along)
        spread[place] = centred.T @ centred
    tangents[long] = np.linalg.eigh(spread)[1][:, :, 2]
    for i, path in enumerate(paths):
        if len(path) == 1:
            tangents[i] *= -1.0 if i and paths[i - 1] is path else 1.0
            continue
        mean = tangents[i]
        tangent = mean if mean @ (points[path[0]] - points[path[-1]]) >= 0 else -mean
        tangents[i] = tangent / max(math.sqrt(tangent @ tangent), 1e-12)
    return tangents
