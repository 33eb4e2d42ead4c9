import networkx as nx
import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from canopy_skel.initial import (
    InitialConfig,
    consolidate,
    initial_skeleton,
    prune_spurs,
    spanning_forest,
)
from canopy_skel.likelihood import LikelihoodConfig, LikelihoodMap, Segments
from canopy_skel.strands import SmoothingConfig, StrandMap, sample_segments

VOXEL = 0.005


def segments_from(starts, ends, radius_m=0.004):
    return Segments(
        starts_in_base=np.asarray(starts, float),
        ends_in_base=np.asarray(ends, float),
        radius_m=np.full(len(starts), radius_m),
        confidence=np.full(len(starts), 0.8),
    )


def many_views_of_a_branch(seed=0, views=12, noise_m=0.003):
    """A straight branch along x, seen in pieces that are off by noise."""
    random = np.random.default_rng(seed)
    starts, ends = [], []
    for _ in range(views):
        knots = np.linspace(0, 0.3, 7)
        points = np.stack([knots, np.zeros(7), np.zeros(7)], axis=1)
        points[:, 1:] += random.normal(0, noise_m, (7, 2))
        starts += list(points[:-1])
        ends += list(points[1:])
    return segments_from(starts, ends)


def strands_of(*groups):
    strands = StrandMap(VOXEL, SmoothingConfig())
    for segments in groups:
        strands.add(segments)
    return strands


def skeleton_of(segments):
    likelihood = LikelihoodMap(LikelihoodConfig(voxel_size_m=VOXEL))
    likelihood.add(segments)
    return initial_skeleton(strands_of(segments).smoothed(), likelihood, InitialConfig())


def length_of(graph):
    ends = graph.vertices_in_base[graph.edges]
    return np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1).sum()


@given(st.integers(0, 2**32 - 1), st.sampled_from([0.002, 0.005, 0.01]))
def test_samples_lie_on_their_segments_no_further_apart_than_asked(seed, spacing_m):
    random = np.random.default_rng(seed)
    starts, ends = random.uniform(-0.1, 0.1, (2, 5, 3))
    points, directions, _ = sample_segments(segments_from(starts, ends), spacing_m)
    for start, end in zip(starts, ends, strict=True):
        axis = (end - start) / np.linalg.norm(end - start)
        own = points[(np.abs(directions - axis) < 1e-9).all(axis=1)]
        along = np.sort((own - start) @ axis)
        assert along[0] < 1e-9
        assert abs(along[-1] - np.linalg.norm(end - start)) < 1e-9
        assert np.diff(along).max() <= spacing_m + 1e-12


def test_noisy_views_of_one_branch_become_one_line():
    graph = skeleton_of(many_views_of_a_branch())
    assert graph.components()[0] == 1
    assert 0.29 < length_of(graph) < 1.03 * 0.3
    assert np.abs(graph.vertices_in_base[:, 1:]).max() < 0.003
    assert not graph.occluded.any()
    assert graph.confidence.min() > 0.8


def test_smoothing_keeps_the_ends_where_they_are():
    along = strands_of(many_views_of_a_branch()).smoothed().points_in_base[:, 0]
    assert along.min() < 0.002
    assert along.max() > 0.298


def test_crossing_branches_are_not_pulled_into_each_other():
    segments = segments_from([(-0.1, 0, 0), (0, -0.1, 0.004)], [(0.1, 0, 0), (0, 0.1, 0.004)])
    smoothed = strands_of(segments).smoothed()
    assert set(np.round(smoothed.points_in_base[:, 2], 6)) == {0.0, 0.004}


def part_of(segments, chosen):
    names = ("starts_in_base", "ends_in_base", "radius_m", "confidence")
    return Segments(**{name: getattr(segments, name)[chosen] for name in names})


@given(st.integers(0, 2**32 - 1))
def test_smoothing_what_has_changed_gives_what_smoothing_everything_gives(seed):
    random = np.random.default_rng(seed)
    starts = random.uniform(-0.1, 0.1, (12, 3))
    segments = segments_from(starts, starts + random.normal(0, 0.04, (12, 3)))
    views = [part_of(segments, slice(i, i + 3)) for i in range(0, 12, 3)]
    grown = strands_of()
    for view in views:
        grown.add(view)
        grown.smoothed()
    grown.remove(views[1])
    grown.smoothed()
    grown.add(views[1])
    grown.remove(views[2])
    one = grown.smoothed()
    other = strands_of(views[3], views[1], views[0]).smoothed()
    for name in ("points_in_base", "radius_m", "weight"):
        assert getattr(one, name).tobytes() == getattr(other, name).tobytes()


def test_strands_do_not_grow_with_the_number_of_views():
    few = strands_of(many_views_of_a_branch(views=200)).smoothed()
    many = strands_of(many_views_of_a_branch(views=1000)).smoothed()
    assert len(many.weight) < 1.6 * len(few.weight)
    assert many.weight.sum() > 4.9 * few.weight.sum()


@given(st.integers(0, 2**32 - 1))
def test_the_order_of_segments_does_not_matter_to_the_bit(seed):
    segments = many_views_of_a_branch(seed, views=4)
    order = np.random.default_rng(seed).permutation(len(segments.starts_in_base))
    shuffled = Segments(
        starts_in_base=segments.starts_in_base[order],
        ends_in_base=segments.ends_in_base[order],
        radius_m=segments.radius_m[order],
        confidence=segments.confidence[order],
    )
    one, other = skeleton_of(segments), skeleton_of(shuffled)
    assert one.vertices_in_base.tobytes() == other.vertices_in_base.tobytes()
    assert one.edges.tobytes() == other.edges.tobytes()


@given(st.integers(0, 2**32 - 1), st.integers(0, 60))
def test_the_forest_is_the_euclidean_one_over_neighbouring_voxels(seed, count):
    random = np.random.default_rng(seed)
    voxels = np.unique(random.integers(-4, 4, (count, 3)), axis=0).reshape(-1, 3)
    points = (voxels + random.uniform(0.01, 0.99, voxels.shape)) * VOXEL
    edges = spanning_forest(points, VOXEL)
    everything = nx.Graph()
    everything.add_nodes_from(range(len(points)))
    for a in range(len(points)):
        for b in range(a):
            if np.abs(voxels[a] - voxels[b]).max() <= 1:
                gap = float(np.linalg.norm(points[a] - points[b]))
                everything.add_edge(a, b, weight=gap)
    expected = nx.minimum_spanning_tree(everything)
    assert {tuple(sorted(e)) for e in edges.tolist()} == {tuple(sorted(e)) for e in expected.edges}


@given(st.integers(0, 2**32 - 1))
def test_a_straight_piece_of_wood_stays_one_piece(seed):
    random = np.random.default_rng(seed)
    direction = random.normal(size=3)
    if seed % 4 == 0:
        direction = np.sign(direction)  # through the corners of voxels
    start = random.uniform(-0.1, 0.1, 3) * (seed % 3 > 0)
    end = start + 0.3 * direction / np.linalg.norm(direction)
    graph = skeleton_of(segments_from([start], [end]))
    assert graph.components()[0] == 1


def test_one_vertex_per_voxel_inside_it():
    vertices, radius_m = consolidate(strands_of(many_views_of_a_branch()).smoothed(), VOXEL)
    voxels = np.floor(vertices / VOXEL)
    assert len(np.unique(voxels, axis=0)) == len(vertices)
    np.testing.assert_allclose(radius_m, 0.004, atol=1e-6)


def test_spurs_go_and_twigs_stay():
    trunk = [(0.01 * i, 0, 0) for i in range(11)]
    spur = [(0.05, 0.01, 0)]
    twig = [(0.03, 0.01 * i, 0) for i in range(1, 5)]
    points = np.array(trunk + spur + twig, float)
    edges = [(i, i + 1) for i in range(10)] + [(5, 11)] + [(3, 12)]
    edges += [(12, 13), (13, 14), (14, 15)]
    kept, remaining = prune_spurs(points, np.array(edges), 0.02)
    assert set(range(16)) - set(kept.tolist()) == {11}
    assert len(remaining) == len(kept) - 1


@given(st.integers(0, 2**32 - 1), st.integers(1, 80))
def test_pruning_keeps_components_and_leaves_no_short_spur(seed, count):
    random = np.random.default_rng(seed)
    points = random.uniform(0, 0.08, (count, 3))
    points = points[np.unique(np.floor(points / 0.02), axis=0, return_index=True)[1]]
    count = len(points)
    edges = spanning_forest(points, 0.02)
    kept, remaining = prune_spurs(points, edges, 0.02)
    before, after = nx.Graph(edges.tolist()), nx.Graph(remaining.tolist())
    before.add_nodes_from(range(count))
    after.add_nodes_from(range(len(kept)))
    assert nx.number_connected_components(before) == nx.number_connected_components(after)
    for tip in [v for v in after if after.degree(v) == 1]:
        length, previous, at = 0.0, tip, next(iter(after[tip]))
        length += np.linalg.norm(points[kept[tip]] - points[kept[at]])
        while after.degree(at) == 2:
            previous, at = at, next(v for v in after[at] if v != previous)
            length += np.linalg.norm(points[kept[previous]] - points[kept[at]])
        assert after.degree(at) == 1 or length > 0.02


def test_nothing_seen_nothing_there():
    graph = skeleton_of(segments_from(np.zeros((0, 3)), np.zeros((0, 3))))
    assert len(graph.vertices_in_base) == 0
    assert len(graph.edges) == 0
