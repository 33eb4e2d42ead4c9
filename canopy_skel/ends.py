"""Free ends of a forest: where wood goes on that no view has shown."""

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
    vertex, tangents, behind = [], [], []
    for v, around in enumerate(neighbours):
        if len(around) > 1:
            continue
        if not around:
            vertex += [v, v]
            tangents += [directions[v], -directions[v]]
            behind += [0.0, 0.0]
            continue
        path, length_m = _path_from(v, neighbours, points)
        vertex.append(v)
        tangents.append(_tangent(points[path], directions[path], length_m))
        behind.append(length_m)
    return Ends(
        vertex=np.array(vertex, dtype=np.int64),
        tangents=np.array(tangents).reshape(-1, 3),
        behind_m=np.array(behind),
    )


def _path_from(
    end: int, neighbours: list[list[int]], points: FloatArray
) -> tuple[list[int], float]:
    path, length_m, onward = [end], 0.0, neighbours[end]
    while len(onward) == 1 and length_m < TANGENT_M:
        came, here = path[-1], onward[0]
        path.append(here)
        length_m += float(np.linalg.norm(points[here] - points[came]))
        onward = [v for v in neighbours[here] if v != came]
    return path, length_m


def _tangent(points: FloatArray, directions: FloatArray, length_m: float) -> FloatArray:
    out = points[0] - points[-1]
    if length_m < _SHORTEST_M:
        mean = directions[0]
    else:
        centred = points - points.mean(axis=0)
        mean = np.linalg.eigh(centred.T @ centred)[1][:, 2]
    tangent = mean if mean @ out >= 0 else -mean
    return np.asarray(tangent / max(float(np.linalg.norm(tangent)), 1e-12))
