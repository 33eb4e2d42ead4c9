"""The skeleton as a graph: what every stage after the map hands on."""

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from canopy_skel.geometry import BoolArray, FloatArray, IntArray


@dataclass(frozen=True, kw_only=True, eq=False, slots=True)
class SkeletonGraph:
    """An undirected acyclic graph in the base frame.

    vertices_in_base: (V, 3) metres. edges: (E, 2) vertex indices. radius_m: (V,).
    occluded: (V,) bool, predicted by a search and not observed. confidence: (V,) in [0, 1].
    """

    vertices_in_base: FloatArray
    edges: IntArray
    radius_m: FloatArray
    occluded: BoolArray
    confidence: FloatArray

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

    def components(self) -> tuple[int, IntArray]:
        """Return the number of connected components and the component of each vertex (V,)."""
        n = len(self.vertices_in_base)
        adjacency = coo_array(
            (np.ones(len(self.edges), dtype=np.int8), (self.edges[:, 0], self.edges[:, 1])),
            shape=(n, n),
        )
        count, labels = connected_components(adjacency, directed=False)
        return int(count), labels.astype(np.int64)
