import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from canopy_skel.fusion import Observations
from canopy_skel.slivers import inside_thicker, on_axis

TRUNK_M = 0.04
ALONG_X = (1.0, 0.0, 0.0)


def with_strip(trunk, point, *, radius_m=0.015, direction=ALONG_X, fragment=False, of_masks=True):
    """A trunk along x, seen whole at the places (N,), and one point beside its axis."""
    count = len(trunk)
    return Observations(
        points_in_base=np.vstack([np.outer(trunk, ALONG_X), point]),
        directions=np.vstack([np.tile(ALONG_X, (count, 1)), direction]),
        radius_m=np.append(np.full(count, TRUNK_M), radius_m),
        probable_radius_m=np.append(np.full(count, TRUNK_M), 1.1 * radius_m),
        probability=np.full(count + 1, 0.9),
        view=np.zeros(count + 1, dtype=np.int64),
        fragment=np.append(np.full(count, not of_masks), fragment),
    )


@pytest.mark.parametrize(
    ("offset_m", "radius_m", "direction", "fragment", "swallowed"),
    [
        (0.025, 0.015, ALONG_X, False, True),
        (0.025, 0.015, ALONG_X, True, True),
        (0.045, 0.015, ALONG_X, False, False),  # a twig before the trunk
        (0.025, 0.015, (0, 1.0, 0), False, False),  # a branch that leaves it
        (0.025, 0.035, ALONG_X, False, False),  # the trunk itself, measured otherwise
    ],
)
def test_strips_that_leaves_cut_off_a_trunk_are_not_wood_of_their_own(
    offset_m, radius_m, direction, fragment, swallowed
):
    trunk = np.linspace(-0.1, 0.1, 41)
    seen = with_strip(
        trunk, [0, offset_m, 0], radius_m=radius_m, direction=direction, fragment=fragment
    )
    found = inside_thicker(seen)
    assert not found[:-1].any()
    assert found[-1] == swallowed


BELOW_AND_ABOVE = np.concatenate([np.arange(-0.2, -0.1, 0.01), np.arange(0.1, 0.2, 0.01)])


@pytest.mark.parametrize("fragment", [False, True])
@pytest.mark.parametrize("backwards", [False, True])
def test_bark_between_places_where_the_trunk_is_seen_whole_moves_onto_its_axis(fragment, backwards):
    way = -np.array(ALONG_X) if backwards else np.array(ALONG_X)
    seen = with_strip(BELOW_AND_ABOVE, [0.03, 0.035, 0.0], direction=way, fragment=fragment)
    moved = on_axis(seen)
    assert moved.points_in_base[-1] == pytest.approx([0.03, 0, 0], abs=1e-9)
    assert moved.directions[-1] == pytest.approx(way)
    assert moved.radius_m[-1] == moved.probable_radius_m[-1] == pytest.approx(TRUNK_M)
    np.testing.assert_array_equal(moved.points_in_base[:-1], seen.points_in_base[:-1])
    np.testing.assert_array_equal(moved.radius_m[:-1], seen.radius_m[:-1])


@pytest.mark.parametrize(
    "seen",
    [
        with_strip(BELOW_AND_ABOVE, [0.0, 0.06, 0.0]),
        with_strip(BELOW_AND_ABOVE, [0.0, 0.035, 0.0], direction=(0.8, 0.6, 0.0)),
        with_strip(BELOW_AND_ABOVE, [0.0, 0.035, 0.0], radius_m=0.036),
        with_strip(BELOW_AND_ABOVE[:10], [0.0, 0.035, 0.0]),
        with_strip(4 * BELOW_AND_ABOVE, [0.0, 0.035, 0.0]),
        with_strip(BELOW_AND_ABOVE, [0.0, 0.035, 0.0], of_masks=False),
    ],
    ids=["a twig before it", "leaves it", "as thick", "thick below only", "too far", "guessed"],
)
def test_what_may_be_wood_of_its_own_stays(seen):
    np.testing.assert_array_equal(on_axis(seen).points_in_base, seen.points_in_base)


def test_of_several_thick_limbs_the_thickest_on_both_sides_counts():
    seen = with_strip(BELOW_AND_ABOVE, [0.0, 0.03, 0.0])
    strip_between = with_strip(
        np.concatenate([BELOW_AND_ABOVE, [-0.05, -0.04, 0.04, 0.05]]), [0.0, 0.03, 0.0]
    )
    strip_between.points_in_base[20:24, 1] = 0.02
    strip_between.radius_m[20:24] = 0.021
    for one in (seen, strip_between):
        assert on_axis(one).points_in_base[-1] == pytest.approx([0, 0, 0], abs=1e-9)


def test_where_the_trunk_is_seen_right_beside_the_strip_its_own_direction_counts():
    trunk = np.repeat([-0.006, 0.006], 4)
    seen = with_strip(trunk, [0.0, 0.035, 0.0])
    seen.points_in_base[:8, 2] = np.tile([-0.013, -0.004, 0.004, 0.013], 2)
    seen.points_in_base[:4, 1], seen.points_in_base[4:8, 1] = -0.006, 0.006
    moved = on_axis(seen)
    assert moved.points_in_base[-1] == pytest.approx([0, 0, 0], abs=1e-9)
    assert moved.directions[-1] == pytest.approx(ALONG_X)


def test_nothing_seen_stays_nothing():
    seen = with_strip(BELOW_AND_ABOVE, [0.0, 0.0, 0.0]).chosen(np.zeros(21, dtype=np.bool_))
    assert len(on_axis(seen).points_in_base) == 0


@settings(deadline=None, max_examples=25)
@given(
    turn=st.tuples(*[st.floats(-3, 3)] * 3),
    shift=st.tuples(*[st.floats(-2, 2)] * 3),
    place=st.tuples(st.floats(-0.05, 0.05), st.floats(-0.03, 0.03), st.floats(-0.03, 0.03)),
)
def test_the_axis_is_found_wherever_the_tree_stands_and_leans(turn, shift, place):
    seen = with_strip(BELOW_AND_ABOVE, place)
    rotation = Rotation.from_rotvec(turn)
    elsewhere = Observations(
        points_in_base=rotation.apply(seen.points_in_base) + shift,
        directions=rotation.apply(seen.directions),
        radius_m=seen.radius_m,
        probable_radius_m=seen.probable_radius_m,
        probability=seen.probability,
        view=seen.view,
        fragment=seen.fragment,
    )
    expected = rotation.apply([place[0], 0, 0]) + shift
    assert on_axis(elsewhere).points_in_base[-1] == pytest.approx(expected, abs=1e-6)
