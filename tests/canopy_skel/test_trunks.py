import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from canopy_skel.evidence import THROUGH
from canopy_skel.frame import Intrinsics, View
from canopy_skel.fusion import Observations
from canopy_skel.outlines import Outlines, outlines_of
from canopy_skel.pieces import PieceConfig, pieces_of, regions_of_masks
from canopy_skel.segment import BranchMask
from canopy_skel.trunks import onto_trunks

TRUNK_M, STRIP_M = 0.04, 0.014
UP = np.array([0.0, 0.0, 1.0])
EYES = [np.array([-1.2, y, 0.0]) for y in (-0.5, -0.2, 0.1, 0.4)]
WIDEST_M = 0.03
"""Radius of the widest strip around."""


def nothing_seen(points):
    return np.zeros((len(points), 6), dtype=np.int64)


def seen_by(eye, axis_y=0.0, rng=None):
    """What a camera sees of a trunk of TRUNK_M upright at (0, axis_y): bark, and both outlines."""
    rng = rng or np.random.default_rng(1)
    centre = np.array([0.0, axis_y])
    towards = eye[:2] - centre
    distance_m = np.linalg.norm(towards)
    facing = np.arctan2(towards[1], towards[0])
    angle = facing + rng.uniform(-1.2, 1.2, 120)
    height = rng.uniform(-0.15, 0.15, 120)
    at = centre + TRUNK_M * np.column_stack([np.cos(angle), np.sin(angle)])
    bark = np.column_stack([at, height])
    half = np.arccos(TRUNK_M / distance_m)
    touching = [facing + half, facing - half]
    sides = np.array([[np.cos(a), np.sin(a)] for a in touching])
    inward = -np.repeat(sides, 30, axis=0)
    outline = np.column_stack(
        [np.repeat(centre + TRUNK_M * sides, 30, axis=0), np.tile(np.linspace(-0.15, 0.15, 30), 2)]
    )
    return Outlines(
        bark=np.column_stack(
            [bark, unit(bark - eye), np.tile(UP, (len(bark), 1)), np.full(len(bark), WIDEST_M)]
        ),
        outline=np.column_stack(
            [outline, unit(outline - eye), inward, 0 * height[:60], np.tile(UP, (60, 1))]
        ),
    )


def unit(vectors):
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def strips(offset=(-0.03, 0.012), direction=UP, fragment=False):
    """Points of strips that leaves leave of the trunk, beside its axis."""
    height = np.arange(-0.1, 0.1, 0.005)
    points = np.column_stack([np.tile(offset, (len(height), 1)), height])
    count = len(points)
    return Observations(
        points_in_base=points,
        directions=np.tile(unit(np.array([direction]))[0], (count, 1)),
        radius_m=np.full(count, STRIP_M),
        probability=np.full(count, 0.9),
        view=np.zeros(count, dtype=np.int64),
        fragment=np.full(count, fragment),
    )


def turned(seen, outlines, turn, shift):
    def of(lines, places, ways):
        lines = lines.copy()
        for at in (*places, *ways):
            lines[:, at : at + 3] = turn.apply(lines[:, at : at + 3])
        for at in places:
            lines[:, at : at + 3] += shift
        return lines

    moved = Observations(
        points_in_base=turn.apply(seen.points_in_base) + shift,
        directions=turn.apply(seen.directions),
        radius_m=seen.radius_m,
        probability=seen.probability,
        view=seen.view,
        fragment=seen.fragment,
    )
    return moved, [
        Outlines(bark=of(one.bark, (0,), (3, 6)), outline=of(one.outline, (0,), (3, 6, 9)))
        for one in outlines
    ]


@settings(max_examples=25, deadline=None)
@given(
    turn=st.integers(0, 1000).map(lambda seed: Rotation.random(random_state=seed)),
    shift=st.tuples(*[st.floats(-2, 2)] * 3),
)
def test_strips_of_a_trunk_come_onto_its_axis_however_it_stands(turn, shift):
    seen, outlines = turned(strips(), [seen_by(eye) for eye in EYES], turn, np.array(shift))
    found = onto_trunks(seen, outlines, nothing_seen)
    places = turn.inv().apply(found.points_in_base - np.array(shift))
    assert np.linalg.norm(places[:, :2], axis=1) == pytest.approx(0, abs=0.004)
    assert found.radius_m == pytest.approx(TRUNK_M, rel=0.1)
    assert np.sum(found.directions * turn.apply(UP), axis=1) == pytest.approx(1)


def test_which_view_came_first_does_not_matter_to_what_is_found():
    outlines = [seen_by(eye) for eye in EYES]
    found = onto_trunks(strips(), outlines, nothing_seen)
    backwards = onto_trunks(strips(), outlines[::-1], nothing_seen)
    assert backwards.points_in_base == pytest.approx(found.points_in_base, abs=1e-3)


def between_the_outlines(points):
    said = nothing_seen(points)
    said[:, THROUGH] = np.linalg.norm(points[:, :2], axis=1) < 0.01
    return said


@pytest.mark.parametrize(
    ("seen", "outlines", "evidence"),
    [
        (strips(), [seen_by(eye) for eye in EYES], between_the_outlines),
        (strips(fragment=True), [seen_by(eye) for eye in EYES], nothing_seen),
        (strips(direction=(0.8, 0, 0.6)), [seen_by(eye) for eye in EYES], nothing_seen),
        (strips(offset=(-0.2, 0.0)), [seen_by(eye) for eye in EYES], nothing_seen),
        (strips(), [], nothing_seen),
        (strips().chosen(np.zeros(40, dtype=bool)), [], nothing_seen),
    ],
    ids=["seen through", "a fragment", "leaves it", "elsewhere", "nothing known", "no wood"],
)
def test_what_is_no_strip_of_a_trunk_stays(seen, outlines, evidence):
    found = onto_trunks(seen, outlines, evidence)
    np.testing.assert_array_equal(found.points_in_base, seen.points_in_base)
    np.testing.assert_array_equal(found.radius_m, seen.radius_m)


def test_two_branches_beside_each_other_with_sky_between_are_no_trunk():
    apart_m = 0.06
    both = [seen_by(eye, y) for eye in EYES for y in (-apart_m, apart_m)]
    seen = strips(offset=(-0.03, apart_m - 0.012))
    found = onto_trunks(seen, both, nothing_seen)
    assert (found.radius_m < 1.2 * TRUNK_M).all()
    assert (found.points_in_base[:, 1] > 0.5 * apart_m).all()


SIZE = (120, 200)
CAMERA = Intrinsics(fx_px=300, fy_px=300, cx_px=100, cy_px=60, width_px=200, height_px=120)
TRUNK_PX = slice(90, 110)


def shown(left_m, right_m, columns=TRUNK_PX):
    """What a picture shows of an upright strip 1 m away with such depths beside it."""
    depth_m = np.full(SIZE, np.nan, dtype=np.float32)
    depth_m[:, : columns.start], depth_m[:, columns.stop :] = left_m, right_m
    depth_m[:, columns] = 1.0
    view = View(
        index=0,
        stamp_ns=0,
        color_rgb=np.zeros((*SIZE, 3), dtype=np.uint8),
        intrinsics=CAMERA,
        base_from_camera=np.eye(4),
        depth_m=depth_m,
    )
    shape = (80, columns.stop - columns.start)
    masks = [
        BranchMask(
            instance=1,
            left_px=columns.start,
            top_px=20,
            mask=np.ones(shape, dtype=bool),
            confidence=0.9,
        )
    ]
    regions, config = regions_of_masks(masks), PieceConfig()
    return outlines_of(view, regions, pieces_of(view, regions, config, fragments=False), config)


def outline_columns(*beside):
    places = shown(*beside).outline[:, :3]
    return sorted({round(float(u), 1) for u in CAMERA.project(places)[:, 0]})


def test_an_outline_is_where_something_farther_is_beside_the_wood():
    assert outline_columns(2.0, 2.0) == [89.5, 109.5]
    assert outline_columns(2.0, 0.9) == [89.5]  # a leaf in front
    assert outline_columns(1.02, 2.0) == [109.5]  # a leaf beside it
    assert outline_columns(np.nan, 0.9) == [89.5]  # sky
    assert outline_columns(2.0, 2.0, slice(0, 20)) == [19.5]  # the picture ends


def test_bark_is_where_the_mask_has_depth():
    bark = shown(2.0, 0.9).bark
    assert len(bark) == 64
    assert bark[:, 2] == pytest.approx(1.0)
    columns = CAMERA.project(bark[:, :3])[:, 0]
    assert ((columns > TRUNK_PX.start - 0.5) & (columns < TRUNK_PX.stop)).all()
    assert np.abs(bark[:, 7]) == pytest.approx(1.0)  # it runs down the picture
    assert bark[:, 9] == pytest.approx(10 / CAMERA.fx_px, rel=0.05)
