import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from canopy_skel.document import Method, SkeletonDocument, build_document
from canopy_skel.errors import UsageError
from canopy_skel.graph import SkeletonGraph
from canopy_skel.volume import wood_volume_m3


def document(points, edges, radii) -> SkeletonDocument:
    points = np.array(points, dtype=float).reshape(-1, 3)
    graph = SkeletonGraph(
        vertices_in_base=points,
        edges=np.array(edges, dtype=np.int64).reshape(-1, 2),
        radius_m=np.array(radii, dtype=float),
        occluded=np.zeros(len(points), dtype=bool),
        confidence=np.ones(len(points)),
    )
    return build_document(graph, scan_id="s", revision=0, method=Method(name="paper"), views_used=0)


def cone_m3(length, r0, r1):
    """A truncated cone with a half ball at either end."""
    balls = 2 / 3 * np.pi * (r0**3 + r1**3)
    return np.pi * length / 3 * (r0**2 + r0 * r1 + r1**2) + balls


directions = st.tuples(*[st.floats(-1, 1)] * 3).filter(lambda v: np.linalg.norm(v) > 0.1)


@settings(max_examples=20)
@given(directions, st.floats(0.006, 0.03), st.floats(0.3, 1.0), st.floats(0.1, 0.4))
def test_a_tapered_tube_has_the_volume_of_its_cone(direction, radius, taper, length):
    end = np.array(direction) / np.linalg.norm(direction) * length
    tube = document([(0, 0, 0), end], [(0, 1)], [radius, taper * radius])
    assert wood_volume_m3(tube) == pytest.approx(cone_m3(length, radius, taper * radius), rel=0.04)


def test_wood_drawn_twice_counts_once():
    points = [(0, 0, 0), (0, 0, 0.3), (0.001, 0, 0), (0.001, 0, 0.3)]
    once = document(points[:2], [(0, 1)], [0.02] * 2)
    twice = document(points, [(0, 1), (2, 3)], [0.02] * 4)
    apart = document([*points[:2], (1, 0, 0), (1, 0, 0.3)], [(0, 1), (2, 3)], [0.02] * 4)
    assert wood_volume_m3(twice) < 1.05 * wood_volume_m3(once)
    assert wood_volume_m3(apart) == pytest.approx(2 * wood_volume_m3(once), rel=1e-2)


def test_a_twig_does_not_swell_where_it_leaves_the_trunk():
    trunk = [(0, 0, 0), (0, 0, 0.2), (0, 0, 0.4)]
    bare = document(trunk, [(0, 1), (1, 2)], [0.04] * 3)
    forked = document([*trunk, (0.3, 0, 0.2)], [(0, 1), (1, 2), (1, 3)], [0.04] * 3 + [0.005])
    outside_m3 = np.pi * 0.005**2 * (0.3 - 0.04)
    grown_m3 = wood_volume_m3(forked, voxel_m=0.001) - wood_volume_m3(bare, voxel_m=0.001)
    assert grown_m3 == pytest.approx(outside_m3, rel=0.1)


def test_only_the_wood_among_the_given_vertices():
    stem = document([(0, 0, 0), (0, 0, 0.1), (0, 0, 0.3)], [(0, 1), (1, 2)], [0.01] * 3)
    lower = stem.position[:, 2] < 0.2
    assert wood_volume_m3(stem, among=lower) == pytest.approx(cone_m3(0.1, 0.01, 0.01), rel=0.03)


def test_nothing_has_no_volume():
    assert wood_volume_m3(document([], [], [])) == 0.0
    assert wood_volume_m3(document([(0, 0, 0)], [], [0.01])) == 0.0


def test_a_resolution_that_is_none_is_refused():
    with pytest.raises(UsageError, match="give a length above 0"):
        wood_volume_m3(document([], [], []), voxel_m=0.0)
