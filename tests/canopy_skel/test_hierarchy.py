import json
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from mcap.reader import make_reader

from canopy_skel.document import Method, build_document, to_json
from canopy_skel.graph import SkeletonGraph
from canopy_skel.hierarchy import Hierarchy, build_hierarchy

RECORDINGS = Path(__file__).parents[2] / "../shared/data/recordings"


def skeleton(points, edges, radius=0.01, confidence=1.0) -> SkeletonGraph:
    points = np.array(points, dtype=np.float64).reshape(-1, 3)
    n = len(points)
    return SkeletonGraph(
        vertices_in_base=points,
        edges=np.array(edges, dtype=np.int64).reshape(-1, 2),
        radius_m=np.broadcast_to(np.asarray(radius, dtype=np.float64), n).copy(),
        occluded=np.zeros(n, dtype=np.bool_),
        confidence=np.broadcast_to(np.asarray(confidence, dtype=np.float64), n).copy(),
    )


def line(start, end, count=20):
    return np.linspace(start, end, count)


def joined(*limbs) -> SkeletonGraph:
    """Make a skeleton of (points, radius) limbs; limbs that share a point are joined there."""
    index: dict[tuple[float, ...], int] = {}
    radius: list[float] = []
    edges = []
    for points, limb_radius in limbs:
        ids = []
        for point in points:
            key = tuple(np.round(point, 6).tolist())
            if key not in index:
                index[key] = len(index)
                radius.append(limb_radius)
            ids.append(index[key])
        edges += list(pairwise(ids))
    return skeleton(list(index), edges, radius)


@st.composite
def forests(draw) -> SkeletonGraph:
    n = draw(st.integers(0, 30))
    # A coarse grid, so that some vertices coincide.
    coordinate = st.integers(0, 4).map(lambda i: i * 0.013)
    points = [draw(st.tuples(coordinate, coordinate, coordinate)) for _ in range(n)]
    edges = []
    for v in range(1, n):
        parent = draw(st.integers(-1, v - 1))
        if parent >= 0:
            edges.append((v, parent))
    fraction = st.integers(0, 3).map(lambda i: i / 3)
    radius = [draw(fraction) * 0.02 for _ in range(n)]
    confidence = [draw(fraction) for _ in range(n)]
    return skeleton(points, edges, radius, confidence)


def shuffled(graph: SkeletonGraph, seed: int) -> SkeletonGraph:
    rng = np.random.default_rng(seed)
    old_of_new = rng.permutation(len(graph.vertices_in_base))
    new_of_old = np.argsort(old_of_new)
    edges = rng.permuted(new_of_old[graph.edges].reshape(-1, 2), axis=1)
    return SkeletonGraph(
        vertices_in_base=graph.vertices_in_base[old_of_new],
        edges=rng.permutation(edges, axis=0),
        radius_m=graph.radius_m[old_of_new],
        occluded=graph.occluded[old_of_new],
        confidence=graph.confidence[old_of_new],
    )


def document_bytes(graph: SkeletonGraph) -> bytes:
    return to_json(
        build_document(graph, scan_id="s", revision=0, method=Method(name="test"), views_used=1)
    )


def edge_places(graph: SkeletonGraph) -> list:
    ends = graph.vertices_in_base[graph.edges].tolist()
    return sorted(sorted(pair) for pair in ends)


@given(forests())
def test_branches_partition_the_edges_and_hang_on_their_parents(graph):
    hierarchy = build_hierarchy(graph)

    assert edge_places(hierarchy.graph) == edge_places(graph)
    steps = [step for branch in hierarchy.branches for step in pairwise(branch.vertices)]
    assert sorted(sorted(step) for step in steps) == sorted(hierarchy.graph.edges.tolist())
    assert all(hierarchy.parent[outer] == inner for inner, outer in steps)
    for i, branch in enumerate(hierarchy.branches):
        if branch.parent is None:
            assert hierarchy.parent[branch.vertices[0]] == -1
        else:
            parent = hierarchy.branches[branch.parent]
            assert branch.parent < i
            assert branch.order == parent.order + 1
            assert branch.vertices[0] in parent.vertices[1:]


@given(forests())
def test_each_component_has_one_root_and_paths_to_it_go_down_in_number(graph):
    hierarchy = build_hierarchy(graph)
    count, label = hierarchy.graph.components()

    roots = np.flatnonzero(hierarchy.parent < 0)
    assert sorted(label[roots]) == list(range(count))
    assert (hierarchy.parent < np.arange(len(hierarchy.parent))).all()
    # Depth first: each component is one run of numbers that starts at its root.
    assert [label[v] for v in roots] == [run for run, _ in _runs(label)]
    # A branch is one run of numbers too.
    for branch in hierarchy.branches:
        first = branch.vertices[1]
        assert branch.vertices[1:] == tuple(range(first, first + len(branch.vertices) - 1))


def _runs(label):
    start = 0
    for i in range(1, len(label) + 1):
        if i == len(label) or label[i] != label[start]:
            yield label[start], i - start
            start = i


@given(forests(), st.integers(0, 2**32))
def test_same_skeleton_in_another_vertex_order_gives_the_same_bytes(graph, seed):
    assert document_bytes(shuffled(graph, seed)) == document_bytes(graph)


@given(st.integers(0, 2**32))
def test_coincident_vertices_are_told_apart_by_what_hangs_on_them(seed):
    # Three equal vertices on one spot: a tip, the end of a long limb, the end of a short one.
    spot, far, near = (0.0, 0.0, 0.0), (0.0, 0.0, 0.5), (0.1, 0.0, 0.0)
    graph = skeleton([spot, spot, spot, far, near], [(0, 1), (1, 2), (1, 3), (2, 4)])
    assert document_bytes(shuffled(graph, seed)) == document_bytes(graph)


def trunk_of(hierarchy: Hierarchy) -> np.ndarray:
    return hierarchy.graph.vertices_in_base[list(hierarchy.branches[0].vertices)]


def test_root_is_the_foot_of_the_trunk_not_a_twig_that_hangs_lower():
    graph = joined(
        (line((1.7, 0, -0.5), (1.7, 0, 1.0)), 0.04),
        (line((1.7, 0, 1.0), (1.7, 0.9, 0.4)), 0.008),
        (line((1.7, 0.9, 0.4), (1.7, 1.0, -0.7)), 0.004),
    )
    hierarchy = build_hierarchy(graph)
    assert hierarchy.graph.vertices_in_base[0] == pytest.approx([1.7, 0, -0.5])


def test_root_is_not_a_thick_limb_cut_off_high_up_nor_a_weed_beside_the_trunk():
    graph = joined(
        (line((1.7, 0, -0.9), (1.7, 0, 1.0)), 0.03),
        (line((1.7, 0, 0.6), (1.5, 0.4, 0.8)), 0.05),
        (line((1.4, 0.5, -0.95), (1.4, 0.5, -0.8), 5), 0.004),
    )
    hierarchy = build_hierarchy(graph)
    assert hierarchy.graph.vertices_in_base[0] == pytest.approx([1.7, 0, -0.9])


def test_trunk_runs_on_through_forks_past_straight_stubs_and_long_side_limbs():
    leader = line((0, 0, 0), (0, 0, 1.0), 101)
    bent = line((0, 0, 1.0), (0.1, 0, 1.6), 61)
    graph = joined(
        (leader, 0.03),
        (bent, 0.025),
        (line((0, 0, 1.0), (0, 0, 1.03), 4), 0.03),  # a stub, straighter and thicker
        (line((0, 0, 0.5), (0.9, 0, 0.7), 101), 0.02),  # a limb with more wood than the leader
        (line((0.5, 0, 0.5 + 0.2 * 0.5 / 0.9), (0.5, 0.5, 1.0), 51), 0.01),
    )
    trunk = trunk_of(build_hierarchy(graph))
    assert trunk[0] == pytest.approx([0, 0, 0])
    assert trunk[-1] == pytest.approx([0.1, 0, 1.6])


def test_pieces_not_joined_to_the_tree_start_where_they_point_at_the_trunk():
    graph = joined(
        (line((0, 0, 0), (0, 0, 2.0), 101), 0.03),
        (line((0.3, 0, 1.0), (0.8, 0, 1.2)), 0.01),  # a limb whose base is hidden
        (line((0.4, 0, 1.9), (0.9, 0, 1.5)), 0.01),  # one that droops
        (line((0.02, 0, -0.5), (0.02, 0, -0.1), 6), 0.03),  # the foot of the trunk
    )
    hierarchy = build_hierarchy(graph)
    points = hierarchy.graph.vertices_in_base
    starts = sorted(points[hierarchy.parent < 0].tolist())
    expected = [[0, 0, 0], [0.02, 0, -0.5], [0.3, 0, 1.0], [0.4, 0, 1.9]]
    assert np.allclose(starts, expected)
    unjoined = [b for b in hierarchy.branches[1:] if b.parent is None]
    assert [b.order for b in unjoined] == [1, 1, 1]


def test_a_path_of_thirty_thousand_vertices_needs_no_recursion():
    n = 30_000
    graph = skeleton(line((0, 0, 0), (0, 0, 3), n), [(i, i + 1) for i in range(n - 1)])
    assert build_hierarchy(graph).branches[0].vertices == tuple(range(n))


def test_a_star_is_a_trunk_and_its_side_branches():
    arms = [(1, 0, 0), (0, 1, 0), (-1, 0, 0), (0, -1, 0), (0, 0, 1), (0, 0, -1)]
    graph = skeleton([(0, 0, 0), *arms], [(0, i) for i in range(1, 7)])
    branches = build_hierarchy(graph).branches
    assert [b.order for b in branches] == [0, 1, 1, 1, 1]
    assert {b.vertices[0] for b in branches[1:]} == {1}


@pytest.mark.parametrize("edges", [[(0, 1), (1, 2), (2, 0)], [(0, 1), (1, 0)], [(1, 1)]])
def test_cycles_are_refused(edges):
    with pytest.raises(ValueError, match="cycle"):
        build_hierarchy(skeleton([(0, 0, 0), (0, 0, 1), (0, 1, 0)], edges))


@pytest.mark.parametrize("name", ["apple_fd2", "oak_fd3", "walnut_stereo"])
def test_noisy_truth_without_its_order_grows_the_way_the_tree_did(name):
    path = RECORDINGS / f"{name}.mcap"
    if not path.exists():
        pytest.skip(f"{path} is not there; the shared recordings are needed")
    with path.open("rb") as stream:
        truth = json.loads(next(make_reader(stream).iter_attachments()).data)
    rng = np.random.default_rng(1)
    exact = np.array(truth["vertices"]["position"])
    points = exact + rng.normal(0, 0.002, exact.shape)
    radius = np.array(truth["vertices"]["radius"]) * np.exp(rng.normal(0, 0.3, len(points)))
    graph = shuffled(skeleton(points, truth["edges"], radius), seed=2)

    hierarchy = build_hierarchy(graph)

    parent = np.full(len(points), -1)
    for branch in truth["branches"]:
        parent[branch["vertices"][1:]] = branch["vertices"][:-1]
    number = {tuple(point): i for i, point in enumerate(points.tolist())}
    found = [number[tuple(point)] for point in hierarchy.graph.vertices_in_base.tolist()]
    assert found[0] == truth["root"]
    assert [-1 if p < 0 else found[p] for p in hierarchy.parent] == parent[found].tolist()
