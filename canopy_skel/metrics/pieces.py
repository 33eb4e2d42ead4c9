"""A skeleton cut into even pieces: what every figure is measured on."""

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from canopy_skel.geometry import BoolArray, FloatArray, IntArray


@dataclass(frozen=True, kw_only=True, eq=False, slots=True)
class Pieces:
    """Pieces of a skeleton, each standing for its middle point.

    points: (N, 3) metres, the middle of each piece. directions: (N, 3), the unit vector from its
    start to its end, whose sign means nothing (zero where they coincide). length_m: (N,), summing
    to the length of the skeleton. ends: (N, 2) vertices of the edge the point lies on;
    fraction: (N,) where between them.
    """

    points: FloatArray
    directions: FloatArray
    length_m: FloatArray
    ends: IntArray
    fraction: FloatArray

    def blend(self, per_vertex: FloatArray) -> FloatArray:
        """Interpolate a value of the vertices (V,) at the pieces (N,)."""
        start, end = per_vertex[self.ends[:, 0]], per_vertex[self.ends[:, 1]]
        return start + self.fraction * (end - start)

    def flag(self, per_vertex: BoolArray) -> BoolArray:
        """Give each piece (N,) the flag of the nearer end of its edge; half-way counts as not."""
        blended: BoolArray = self.blend(per_vertex.astype(np.float64)) > 0.5 + 1e-9
        return blended


@dataclass(frozen=True, kw_only=True, eq=False, slots=True)
class Chains:
    """The edges of a graph, strung into paths that run from fork or tip to fork or tip.

    positions: (V, 3) metres. edges: (E, 2), each running along its chain, chain after chain.
    chain: (E,) ascending.
    """

    positions: FloatArray
    edges: IntArray
    chain: IntArray

    def pieces(self, spacing_m: float) -> Pieces:
        """Cut every chain that has length into equal pieces no longer than `spacing_m`."""
        start, end = self.positions[self.edges[:, 0]], self.positions[self.edges[:, 1]]
        edge_m = np.linalg.norm(end - start, axis=1)
        edge_end_m = np.cumsum(edge_m)
        first = np.flatnonzero(np.diff(self.chain, prepend=-1))
        last = np.append(first[1:], len(self.edges))[: len(first)] - 1
        chain_start_m = edge_end_m[first] - edge_m[first]
        chain_m = np.bincount(self.chain, weights=edge_m)
        count = np.ceil(chain_m / spacing_m - 1e-9).astype(np.int64)
        count = np.where(chain_m > 0, np.maximum(count, 1), 0)
        of = np.repeat(np.arange(len(first)), count)
        rank = np.arange(len(of), dtype=np.float64) - np.repeat(np.cumsum(count) - count, count)
        length_m = (chain_m / np.maximum(count, 1))[of]

        def locate(rank: FloatArray) -> tuple[FloatArray, IntArray, FloatArray]:
            along_m = chain_start_m[of] + rank * length_m
            edge = np.clip(np.searchsorted(edge_end_m, along_m), first[of], last[of])
            before_m = along_m - (edge_end_m[edge] - edge_m[edge])
            fraction = np.clip(before_m / np.maximum(edge_m[edge], 1e-12), 0.0, 1.0)
            return start[edge] + fraction[:, None] * (end - start)[edge], edge, fraction

        points, edge, fraction = locate(rank + 0.5)
        chord = locate(rank + 1.0)[0] - locate(rank + 0.0)[0]
        norm = np.linalg.norm(chord, axis=1, keepdims=True)
        return Pieces(
            points=points,
            directions=chord / np.maximum(norm, 1e-12),
            length_m=length_m,
            ends=self.edges[edge],
            fraction=fraction,
        )


def simple_edges(edges: IntArray) -> IntArray:
    """Return each undirected edge (E, 2) once, loops left out."""
    ordered = np.sort(edges, axis=1)
    return np.unique(ordered[ordered[:, 0] != ordered[:, 1]], axis=0)


def components_of(vertex_count: int, edges: IntArray) -> IntArray:
    """Number the connected component of each vertex (V,), from 0."""
    ones = np.ones(len(edges), dtype=np.int64)
    shape = (vertex_count, vertex_count)
    adjacency = coo_array((ones, (edges[:, 0], edges[:, 1])), shape=shape)
    return connected_components(adjacency, directed=False)[1].astype(np.int64)


def chains_of(positions: FloatArray, edges: IntArray) -> Chains:
    """String simple edges (E, 2) into chains between the vertices that do not have two edges."""
    degree = np.bincount(edges.ravel(), minlength=len(positions)).tolist()
    incident: list[list[tuple[int, int]]] = [[] for _ in degree]
    for index, (a, b) in enumerate(edges.tolist()):
        incident[a].append((index, b))
        incident[b].append((index, a))
    used = [False] * len(edges)
    walked: list[tuple[int, int, int]] = []
    chain = 0
    for start in sorted(range(len(degree)), key=lambda vertex: degree[vertex] == 2):
        for step in incident[start]:
            here, way = start, [step] if not used[step[0]] else []
            chain += len(way)
            while way:
                index, there = way[0]
                used[index] = True
                walked.append((here, there, chain - 1))
                here = there
                way = [s for s in incident[here] if not used[s[0]]] if degree[here] == 2 else []
    table = np.array(walked, dtype=np.int64).reshape(-1, 3)
    return Chains(positions=positions, edges=table[:, :2], chain=table[:, 2])


def subdivide(
    positions: FloatArray, edges: IntArray, spacing_m: float
) -> tuple[FloatArray, IntArray]:
    """Add vertices so that no edge is longer than `spacing_m`; old vertices keep their index.

    Returns:
        positions (V', 3); edges (E', 2), those of one old edge running the way it did.
    """
    start, end = positions[edges[:, 0]], positions[edges[:, 1]]
    length_m = np.linalg.norm(end - start, axis=1)
    count = np.maximum(np.ceil(length_m / spacing_m - 1e-9), 1).astype(np.int64)
    of = np.repeat(np.arange(len(edges)), count)
    rank = np.arange(len(of)) - np.repeat(np.cumsum(count) - count, count)
    is_last = rank == count[of] - 1
    new = len(positions) - 1 + np.cumsum(~is_last)
    tail = np.where(is_last, edges[of, 1], new)
    head = np.where(rank == 0, edges[of, 0], np.roll(new, 1))
    fraction = ((rank + 1) / count[of])[~is_last, None]
    added = start[of][~is_last] + fraction * (end - start)[of][~is_last]
    return np.concatenate([positions, added]), np.stack([head, tail], axis=1)
