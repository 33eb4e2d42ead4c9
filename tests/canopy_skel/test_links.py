import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from canopy_skel.ends import Ends, find_ends
from canopy_skel.links import Candidates, LinkConfig, Parts, forest_of, links_to_make, places_on


@settings(deadline=None, max_examples=30)
@given(
    points=arrays(np.float64, (12, 3), elements=st.floats(-1, 1, width=32), unique=True),
    parents=st.lists(st.integers(0, 11), min_size=12, max_size=12),
)
def test_every_forest_has_an_end_per_tip_and_two_per_lone_vertex(points, parents):
    edges = np.array([(p % v, v) for v, p in enumerate(parents) if v and p < 9]).reshape(-1, 2)
    degree = np.bincount(edges.ravel(), minlength=12)
    ends = find_ends(points, np.tile([1.0, 0, 0], (12, 1)), edges.astype(np.int64))
    assert np.bincount(ends.vertex, minlength=12).tolist() == [
        {0: 2, 1: 1}.get(d, 0) for d in degree.tolist()
    ]
    np.testing.assert_allclose(np.linalg.norm(ends.tangents, axis=1), 1.0)


@settings(deadline=None, max_examples=50)
@given(
    links=st.lists(
        st.tuples(st.integers(0, 9), st.integers(0, 9), st.booleans(), st.floats(0.01, 0.99)),
        max_size=40,
    ),
    threshold=st.floats(0.1, 0.9),
)
def test_links_make_a_forest_that_joins_all_they_may_by_the_best(links, threshold):
    links = [link for link in links if link[0] != link[1]]
    end = np.array([a for a, *_ in links], dtype=np.int64)
    vertex = np.array([b for _, b, *_ in links], dtype=np.int64)
    other = np.where([at_end for *_, at_end, _ in links], vertex, -1).astype(np.int64)
    probability = np.array([p for *_, p in links])
    candidates = Candidates(
        end=end,
        vertex=vertex,
        other=other,
        curves=np.zeros((len(links), 17, 3)),
        features=np.zeros((len(links), 20)),
        gap_m=np.zeros(len(links)),
        lips=np.ones((len(links), 2)),
        empty=np.zeros(len(links)),
    )
    component = np.arange(10)
    allowed = probability >= threshold
    made = forest_of(candidates, probability, allowed, component, component)
    assert allowed[made].all()
    root = list(range(10))
    for i in made.tolist():
        a, b = root[end[i]], root[vertex[i]]
        assert a != b
        root = [a if r == b else r for r in root]
    # Any link left out closes a ring of links that are all at least as probable.
    for i in np.flatnonzero(allowed).tolist():
        better = made[probability[made] >= probability[i]]
        _, part = connected_components(
            coo_array((np.ones(len(better)), (end[better], vertex[better])), shape=(10, 10)),
            directed=False,
        )
        assert part[end[i]] == part[vertex[i]]


def one_link(*, fragment=False, empty=0.0):
    """Return two parts 0.1 m apart and the straight link between their ends."""
    along = np.array([[1.0, 0, 0], [-1.0, 0, 0]])
    parts = Parts(
        points=np.array([[0.0, 0, 0], [0.1, 0, 0]]),
        directions=along,
        component=np.arange(2),
        length_m=np.full(2, 0.1),
        confidence=np.array([0.9, 0.8]),
        radius_m=np.full(2, 0.005),
        probable_radius_m=np.full(2, 0.005),
        fragment=np.array([False, fragment]),
        ends=Ends(vertex=np.arange(2), tangents=along, behind_m=np.full(2, 0.1)),
    )
    candidates = Candidates(
        end=np.array([0]),
        vertex=np.array([1]),
        other=np.array([1]),
        curves=np.linspace(parts.points[0], parts.points[1], 17)[None],
        features=np.zeros((1, 42)),
        gap_m=np.array([0.1]),
        lips=np.array([[0.9, 0.8]]),
        empty=np.array([empty]),
    )
    return parts, candidates


@pytest.mark.parametrize(
    ("kind", "probability", "made"),
    [({}, 0.3, 1), ({}, 0.2, 0), ({"fragment": True}, 0.3, 0), ({"empty": 0.4}, 0.9, 0)],
)
def test_a_link_must_be_probable_more_so_to_a_fragment_and_not_run_through_the_empty(
    kind, probability, made
):
    config = LinkConfig(min_probability=0.25, min_fragment_probability=0.4, max_empty=0.3)
    assert len(links_to_make(*one_link(**kind), np.array([probability]), config)) == made


def test_places_on_a_link_lie_evenly_within_it_and_know_how_far_its_lips_are():
    _, candidates = one_link()
    places = places_on(candidates, np.array([0]), np.array([0.5]), 0.03)
    np.testing.assert_allclose(places.points[:, 0], [0.025, 0.05, 0.075])
    np.testing.assert_allclose(places.features[:, 0], 0.0, atol=1e-12)  # even odds
    np.testing.assert_allclose(places.features[:, 1:3], [[0.9, 0.8]] * 3)
    np.testing.assert_allclose(
        places.features[:, 3:], [[0.025, 0.075], [0.05, 0.05], [0.025, 0.075]]
    )
    assert places.first.tolist() == [0, 3]
