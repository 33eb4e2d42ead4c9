"""The skeleton as a graph: what every stage after the map hands on."""

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from canopy_skel.geometry import BoolArray, FloatArray, IntArray

SOURCES = ("observed", "fragment", "link", "extension")


@dataclass(frozen=True, kw_only=True, eq=False, slots=True)
class SkeletonGraph:
    """An undirected acyclic graph in the base frame.

    vertices_in_base: (V, 3) metres. edges: (E, 2) vertex indices. radius_m: (V,).
    occluded: (V,) bool, predicted by a search and not observed. confidence: (V,) in [0, 1].
    source: (V,) how each vertex is known, an index into SOURCES; None where nobody says.
    """

    vertices_in_base: FloatArray
    edges: IntArray
    radius_m: FloatArray
    occluded: BoolArray
    confidence: FloatArray
    source: IntArray | None = None

    def __post_init__(self) -> None:
        """Freeze the arrays: graphs are values."""
        for array in (
            self.vertices_in_base,
            self.edges,
            self.radius_m,
            self.occluded,
            self.confidence,
        ):
            array.setflags(write=False)
        if self.source is not None:
            self.source.setflags(write=False)

    def components(self) -> tuple[int, IntArray]:
        """Return the number of connected components and the component of each vertex (V,)."""
        n = len(self.vertices_in_base)
        adjacency = coo_array(
            (np.ones(len(self.edges), dtype=np.int8), (self.edges[:, 0], self.edges[:, 1])),
            shape=(n, n),
        )
        count, labels = connected_components(adjacency, directed=False)
        return int(count), labels.astype(np.int64)


def add_bridges(
    graph: SkeletonGraph, pairs: IntArray, spacing_m: float, confidence: float
) -> SkeletonGraph:
    """Join pairs (M, 2) of vertices by straight occluded pieces no longer than `spacing_m`.

    Radii are interpolated between the two vertices.
    """
    start, end = graph.vertices_in_base[pairs[:, 0]], graph.vertices_in_base[pairs[:, 1]]
    pieces = np.maximum(np.ceil(np.linalg.norm(end - start, axis=1) / spacing_m), 1).astype(int)
    positions, radii, edges = [graph.vertices_in_base], [graph.radius_m], [graph.edges]
    count = len(graph.vertices_in_base)
    for (a, b), number in zip(pairs, pieces, strict=True):
        along = np.arange(1, number)[:, None] / number
        ends, radius = graph.vertices_in_base[[a, b]], graph.radius_m[[a, b]]
        positions.append(ends[0] + along * (ends[1] - ends[0]))
        radii.append(radius[0] + along[:, 0] * (radius[1] - radius[0]))
        chain = np.concatenate([[a], count + np.arange(number - 1), [b]])
        edges.append(np.stack([chain[:-1], chain[1:]], axis=1))
        count += number - 1
    added = count - len(graph.vertices_in_base)
    return SkeletonGraph(
        vertices_in_base=np.concatenate(positions),
        edges=np.concatenate(edges),
        radius_m=np.concatenate(radii),
        occluded=np.append(graph.occluded, np.ones(added, dtype=bool)),
        confidence=np.append(graph.confidence, np.full(added, confidence)),
    )
