from dataclasses import replace

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from oracles import naive_pathsearch

from canopy_skel.graph import SkeletonGraph
from canopy_skel.likelihood import LikelihoodConfig, LikelihoodGrid, LikelihoodMap
from canopy_skel.pathsearch import PathSearch, add_paths, straighten_predicted

VOXEL = 0.01


def map_from(units):
    voxels = np.array(sorted(units), dtype=np.int32).reshape(-1, 3)
    likelihood = LikelihoodMap(LikelihoodConfig(voxel_size_m=VOXEL))
    likelihood.merge(
        LikelihoodGrid(
            voxel_size_m=VOXEL,
            voxels=voxels,
            units=np.array([units[tuple(v)] for v in voxels.tolist()], dtype=np.int32),
        )
    )
    return likelihood


def graph_from(components):
    """A chain through the centres of the voxels of each component."""
    vertices = [v for component in components for v in component]
    edges, first = [], 0
    for component in components:
        edges += [(first + i, first + i + 1) for i in range(len(component) - 1)]
        first += len(component)
    return SkeletonGraph(
        vertices_in_base=(np.array(vertices, dtype=float).reshape(-1, 3) + 0.5) * VOXEL,
        edges=np.array(edges, dtype=np.int64).reshape(-1, 2),
        radius_m=np.full(len(vertices), 0.004),
        occluded=np.zeros(len(vertices), dtype=bool),
        confidence=np.full(len(vertices), 0.9),
    )


@st.composite
def small_maps(draw):
    """A random map, partly saturated (ties!), and disjoint short pieces of skeleton in it."""
    shape = draw(st.tuples(*[st.integers(2, 5)] * 3))
    places = list(np.ndindex(*shape))
    random = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    levels = random.choice([0, 700, 40_000, 300_000, 2_000_000], size=len(places))
    units = {p: int(n) for p, n in zip(places, levels, strict=True) if n > 0}
    free = sorted(units)
    components = []
    for _ in range(draw(st.integers(1, 6))):
        if not free:
            break
        component = [free[random.integers(len(free))]]
        beside = [v for v in free if 0 < max(np.abs(np.subtract(v, component[0]))) <= 1]
        if beside and random.random() < 0.5:
            component.append(beside[random.integers(len(beside))])
        components.append(component)
        free = [v for v in free if v not in component]
    return units, components


def search(units, components):
    likelihood = map_from(units)
    graph = graph_from(components)
    paths = PathSearch(likelihood)
    paths.update(graph)
    return graph, paths.joins(), likelihood


def levels_of(units):
    return {v: naive_pathsearch.level(n) for v, n in units.items()}


@given(small_maps())
@settings(max_examples=500)
def test_joins_are_those_of_the_literal_algorithm(case):
    units, components = case
    _, joins, _ = search(units, components)
    expected = naive_pathsearch.join_paths(levels_of(units), components)
    assert [[tuple(v) for v in join.voxels.tolist()] for join in joins] == expected


@given(small_maps())
@settings(max_examples=60)
def test_costs_are_those_of_all_pairs_in_every_round(case):
    units, components = case
    _, joins, _ = search(units, components)
    assert [join.units for join in joins] == naive_pathsearch.join_costs(
        levels_of(units), components
    )


@given(small_maps())
@settings(max_examples=100)
def test_the_joined_skeleton_is_acyclic_and_inside_the_map(case):
    units, components = case
    graph, joins, likelihood = search(units, components)
    joined = add_paths(graph, joins, likelihood)
    count, _ = joined.components()
    assert len(joined.edges) == len(joined.vertices_in_base) - count
    assert count == len(components) - len(joins)
    voxels = np.floor(joined.vertices_in_base / VOXEL).astype(np.int32)
    assert (likelihood.probability_at(voxels) > 0).all()
    np.testing.assert_array_equal(joined.occluded[: len(graph.occluded)], False)
    assert joined.occluded[len(graph.occluded) :].all()


def test_a_saturated_map_does_not_make_paths_wander():
    units = {(x, y, z): 1 << 30 for x in range(40) for y in range(12) for z in range(12)}
    _, joins, _ = search(units, [[(0, 5, 5)], [(39, 5, 5)]])
    assert len(joins[0].voxels) == 40


def test_a_very_costly_way_is_still_a_way():
    units = {(x, 0, 0): 1 for x in range(1000)}
    _, joins, _ = search(units, [[(0, 0, 0)], [(999, 0, 0)]])
    assert len(joins[0].voxels) == 1000
    assert joins[0].cost_nat > 10_000


def test_no_way_no_join():
    units = {(x, 0, 0): 50_000 for x in range(10) if x != 5}
    _, joins, _ = search(units, [[(0, 0, 0)], [(9, 0, 0)]])
    assert joins == []


def test_a_piece_outside_the_map_stays_alone():
    units = {(x, 0, 0): 50_000 for x in range(10)}
    _, joins, _ = search(units, [[(0, 0, 0)], [(9, 0, 0)], [(30, 30, 30)]])
    assert len(joins) == 1


def test_an_empty_map_joins_nothing():
    _, joins, _ = search({}, [[(0, 0, 0)], [(9, 0, 0)]])
    assert joins == []


def test_a_path_tapers_from_end_to_end():
    graph = replace(graph_from([[(0, 0, 0)], [(9, 0, 0)]]), radius_m=np.array([0.02, 0.002]))
    likelihood = map_from({(x, 0, 0): 50_000 for x in range(10)})
    found = PathSearch(likelihood)
    found.update(graph)
    joined = add_paths(graph, found.joins(), likelihood)
    order = np.argsort(joined.vertices_in_base[:, 0])
    np.testing.assert_allclose(joined.radius_m[order], np.linspace(0.02, 0.002, 10))


def test_straightening_moves_predicted_vertices_only():
    units = {(x, x % 2, 0): 50_000 for x in range(20)}
    graph, joins, likelihood = search(units, [[(0, 0, 0)], [(19, 1, 0)]])
    joined = add_paths(graph, joins, likelihood)
    straight = straighten_predicted(joined, 30)
    np.testing.assert_array_equal(
        straight.vertices_in_base[~joined.occluded], joined.vertices_in_base[~joined.occluded]
    )

    def length(g):
        ends = g.vertices_in_base[g.edges]
        return np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1).sum()

    assert length(straight) < 0.85 * length(joined)
    assert length(straight) >= np.linalg.norm(
        straight.vertices_in_base[0] - straight.vertices_in_base[1]
    )
