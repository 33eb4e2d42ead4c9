import networkx as nx
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from canopy_skel.baselines.ftsem import FtsemConfig, end_vectors, join_break_points
from canopy_skel.baselines.mst import join_by_spanning_tree
from canopy_skel.graph import SkeletonGraph

VOXEL = 0.005


def graph_from(*chains):
    points, edges, first = [], [], 0
    for chain in chains:
        points += list(chain)
        edges += [(first + i, first + i + 1) for i in range(len(chain) - 1)]
        first += len(chain)
    return SkeletonGraph(
        vertices_in_base=np.array(points, float).reshape(-1, 3),
        edges=np.array(edges, dtype=np.int64).reshape(-1, 2),
        radius_m=np.linspace(0.01, 0.004, len(points)),
        occluded=np.zeros(len(points), bool),
        confidence=np.full(len(points), 0.9),
    )


def line(start, end, count=10):
    return np.linspace(start, end, count)


@given(st.integers(0, 2**32 - 1), st.integers(1, 8))
def test_spanning_tree_is_that_of_all_points(seed, pieces):
    random = np.random.default_rng(seed)
    starts = random.uniform(0, 1, (pieces, 3))
    graph = graph_from(*[line(s, s + random.uniform(-0.02, 0.02, 3), 5) for s in starts])
    joined = join_by_spanning_tree(graph, VOXEL)
    count, _ = joined.components()
    assert (count, len(joined.edges)) == (1, len(joined.vertices_in_base) - 1)

    def total(g):
        ends = g.vertices_in_base[g.edges]
        return np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1).sum()

    points = graph.vertices_in_base
    everything = nx.Graph()
    for a in range(len(points)):
        for b in range(a):
            everything.add_edge(a, b, weight=float(np.linalg.norm(points[a] - points[b])))
    for a, b in graph.edges.tolist():
        everything[a][b]["weight"] = 0.0
    bridges = nx.minimum_spanning_tree(everything).size(weight="weight")
    assert total(joined) == pytest.approx(total(graph) + bridges, rel=1e-9)


def test_gaps_are_occluded_pieces_no_longer_than_a_voxel():
    graph = graph_from(line((0, 0, 0), (0.1, 0, 0)), line((0.2, 0, 0), (0.3, 0, 0)))
    joined = join_by_spanning_tree(graph, VOXEL)
    added = joined.vertices_in_base[joined.occluded]
    assert len(added) == 19
    np.testing.assert_allclose(np.sort(added[:, 0]), np.arange(1, 20) * 0.005 + 0.1)
    ends = graph.radius_m[9], graph.radius_m[10]
    assert joined.radius_m[joined.occluded].min() >= min(ends)
    assert joined.radius_m[joined.occluded].max() <= max(ends)


def test_break_points_that_face_each_other_are_joined():
    graph = graph_from(line((0, 0, 0), (0.1, 0, 0)), line((0.2, 0.01, 0), (0.3, 0.01, 0)))
    joined = join_break_points(graph, VOXEL, FtsemConfig())
    assert joined.components()[0] == 1


@pytest.mark.parametrize(
    ("start", "end"),
    [
        ((0.3, 0, 0), (0.4, 0, 0)),  # too far
        ((0.05, 0.08, 0), (0.15, 0.08, 0)),  # beside, not ahead
        ((0.15, 0.0, 0), (0.15, 0.2, 0)),  # ahead, but the two ends do not face each other
    ],
)
def test_break_points_that_fail_a_condition_are_not(start, end):
    graph = graph_from(line((0, 0, 0), (0.1, 0, 0)), line(start, end, 2))
    joined = join_break_points(graph, VOXEL, FtsemConfig())
    assert joined.components()[0] == 2


@given(st.integers(0, 2**32 - 1), st.integers(1, 8))
def test_break_point_joins_make_no_cycle(seed, pieces):
    random = np.random.default_rng(seed)
    starts = random.uniform(0, 0.2, (pieces, 3))
    graph = graph_from(*[line(s, s + random.uniform(-0.1, 0.1, 3)) for s in starts])
    joined = join_break_points(graph, VOXEL, FtsemConfig())
    count, _ = joined.components()
    assert len(joined.edges) == len(joined.vertices_in_base) - count


def test_end_vectors_point_outward():
    vectors = end_vectors(graph_from(line((0, 0, 0), (0.1, 0, 0))), 0.03)
    np.testing.assert_allclose(vectors[0], [-1, 0, 0], atol=1e-12)
    np.testing.assert_allclose(vectors[9], [1, 0, 0], atol=1e-12)


@pytest.mark.parametrize("join", ["mst", "ftsem"])
def test_nothing_stays_nothing(join):
    empty = graph_from()
    joined = (
        join_by_spanning_tree(empty, VOXEL)
        if join == "mst"
        else join_break_points(empty, VOXEL, FtsemConfig())
    )
    assert len(joined.vertices_in_base) == 0
