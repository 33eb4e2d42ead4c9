"""Where the camera sits on the flange: exact from exact views, honest from real ones."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scenes.board import BASE_FROM_BOARD, BOARD, cameras, mounted, picture
from scipy.spatial.transform import Rotation

from canopy_skel.errors import UsageError
from canopy_skel.geometry import invert, transform_from, transform_points
from drivers.board import Board, CornerFinder, drawn
from drivers.hand_eye import BoardView, CalibrationError, apart, calibrate
from mock_hw.orchard.path import OAK_D

GRID = np.array([[0.03 * x, 0.03 * y, 0.0] for x in range(1, 9) for y in range(1, 6)])
turns = st.tuples(*[st.floats(-3, 3)] * 3).filter(lambda turn: np.linalg.norm(turn) < 3.1)
shifts = st.tuples(*[st.floats(-0.3, 0.3)] * 3)


def seen_by(tool_from_camera, poses, noise=None, scale=1.0):
    """Views of the board's corners; `noise(index)` is how wrong the flange's pose is, (4, 4).

    The board is `scale` times as large as it is said to be.
    """
    views = []
    for index, base_from_camera in enumerate(poses):
        corners = transform_points(invert(base_from_camera) @ BASE_FROM_BOARD, GRID)
        wrong = np.eye(4) if noise is None else noise(index)
        views.append(
            BoardView(
                index=index,
                base_from_tool0=base_from_camera @ invert(tool_from_camera) @ wrong,
                intrinsics=OAK_D,
                corners_in_board=GRID / scale,
                pixels=OAK_D.project(corners),
            )
        )
    return views


def only(view, chosen):
    """The view with only these of its corners seen."""
    corners, pixels = view.corners_in_board[chosen], view.pixels[chosen]
    return replace(view, corners_in_board=corners, pixels=pixels)


@given(turns, shifts, st.floats(0.5, 2), st.integers(0, 1000))
@settings(max_examples=30, deadline=None)
def test_exact_views_give_the_camera_wherever_it_hangs(turn, shift_m, scale, seed):
    true = mounted(turn, shift_m)
    found = calibrate(seen_by(true, cameras(8, seed), scale=scale))
    away_m, turned_deg = apart(found.tool_from_camera, true)
    assert away_m < 1e-5
    assert turned_deg < 1e-3
    assert max(apart(found.base_from_board, BASE_FROM_BOARD)) < 1e-3
    assert found.used.all()
    assert found.residual_px.max() < 1e-2
    assert found.position_std_m < 1e-5
    assert found.scale == pytest.approx(scale, rel=1e-4)
    assert found.scale_std < 1e-4


def arm_noise(sigma_m, sigma_rad, seed=5):
    rng = np.random.default_rng(seed)

    def wrong(index):
        turn = Rotation.from_rotvec(rng.normal(0, sigma_rad, 3)).as_matrix()
        return transform_from(turn, rng.normal(0, sigma_m, 3))

    return wrong


@pytest.mark.parametrize("seed", range(5))
def test_with_the_errors_of_a_real_arm_it_is_as_good_as_it_says(seed):
    true = mounted([0.02, -0.03, 0.01], [0.004, 0.002, -0.006])
    found = calibrate(seen_by(true, cameras(20, seed), arm_noise(1e-4, 2e-4, seed)))
    away_m, turned_deg = apart(found.tool_from_camera, true)
    assert away_m < 0.001
    assert turned_deg < 0.04
    assert away_m < 4 * found.position_std_m
    assert turned_deg < 4 * found.turn_std_deg
    assert found.position_std_m < 0.001


def test_a_view_taken_while_the_arm_moved_is_left_out():
    true = mounted([0.02, -0.03, 0.01], [0.004, 0.002, -0.006])

    def one_wrong(index):
        return transform_from(np.eye(3), [0.02, 0, 0]) if index == 3 else np.eye(4)

    found = calibrate(seen_by(true, cameras(12), one_wrong))
    assert np.flatnonzero(~found.used).tolist() == [3]
    assert found.residual_px[3] > 10
    assert apart(found.tool_from_camera, true)[0] < 1e-5


@pytest.mark.parametrize("scale", [0.97, 1.01])
@pytest.mark.parametrize("seed", range(3))
def test_a_board_said_too_large_or_too_small_moves_nothing_and_is_noticed(scale, seed):
    true = mounted([0.02, -0.03, 0.01], [0.004, 0.002, -0.006])
    found = calibrate(seen_by(true, cameras(20, seed), arm_noise(1e-4, 2e-4, seed), scale))
    assert apart(found.tool_from_camera, true)[0] < 0.001
    assert found.scale == pytest.approx(scale, abs=0.001)
    assert abs(found.scale - scale) < 4 * found.scale_std


def test_views_at_one_distance_leave_the_size_of_the_board_open():
    true = mounted([0.02, -0.03, 0.01], [0.004, 0.002, -0.006])
    poses = cameras(20, distances_m=(0.5, 0.5), spread=0.3)
    found = calibrate(seen_by(true, poses, arm_noise(1e-4, 2e-4)))
    assert found.scale_std > 0.001


@pytest.mark.parametrize("moved_m", [0.005, 0.02])
def test_views_after_the_board_moved_are_left_out(moved_m):
    true = mounted([0.02, -0.03, 0.01], [0.004, 0.002, -0.006])
    noise = arm_noise(1e-4, 2e-4)
    moved = transform_from(np.eye(3), [0, moved_m, 0])
    views = [
        replace(view, base_from_tool0=moved @ view.base_from_tool0) if view.index >= 13 else view
        for view in seen_by(true, cameras(20), noise)
    ]
    found = calibrate(views)
    assert np.flatnonzero(~found.used).tolist() == list(range(13, 20))
    assert found.middle_px < 2
    assert apart(found.tool_from_camera, true)[0] < 0.001


def test_when_the_board_moved_halfway_no_half_is_believed():
    true = mounted([0, 0, 0], [0, 0, 0])
    moved = transform_from(np.eye(3), [0, 0.02, 0])
    views = [
        replace(view, base_from_tool0=moved @ view.base_from_tool0) if view.index >= 10 else view
        for view in seen_by(true, cameras(20), arm_noise(1e-4, 2e-4))
    ]
    assert calibrate(views).middle_px > 2


def test_views_of_a_single_row_of_corners_do_no_harm():
    true = mounted([0.02, -0.03, 0.01], [0.004, 0.002, -0.006])
    views = seen_by(true, cameras(20), arm_noise(1e-4, 2e-4))
    rng = np.random.default_rng(1)
    row = GRID[:, 1] == GRID[0, 1]
    for index in (4, 9, 15):
        poor = only(views[index], row)
        views[index] = replace(poor, pixels=poor.pixels + rng.normal(0, 0.1, poor.pixels.shape))
    found = calibrate(views)
    assert apart(found.tool_from_camera, true)[0] < 0.001


@pytest.mark.parametrize("seed", range(4))
def test_views_of_a_patch_of_the_board_do_not_spoil_the_others(seed):
    true = mounted([0.02, -0.03, 0.01], [0.004, 0.002, -0.006])
    rng = np.random.default_rng(seed)
    views = [
        replace(view, pixels=view.pixels + rng.normal(0, 0.1, view.pixels.shape))
        for view in seen_by(true, cameras(20, seed), arm_noise(1e-4, 2e-4, seed))
    ]
    patch = (GRID[:, 0] < 0.1) & (GRID[:, 1] < 0.07)
    some = [only(view, patch) if view.index % 3 == 0 else view for view in views]
    found, others = calibrate(some), calibrate([view for view in some if view.index % 3])
    assert len(some[0].pixels) == 6
    assert found.used.all()
    assert found.position_std_m < 1.2 * others.position_std_m
    assert found.turn_std_deg < 1.2 * others.turn_std_deg
    assert apart(found.tool_from_camera, true)[0] < 3 * found.position_std_m


@pytest.mark.parametrize(
    ("poses", "why"),
    [
        (cameras(5), "5 views .* take at least 6"),
        (cameras(12, rolled=0.0, spread=0.02), r"turned by .*° between views; turn it by 30°"),
        (cameras(12, rolled=0.7, spread=0.0), "about one axis only; tilt it"),
    ],
)
def test_views_that_cannot_tell_are_refused_with_what_is_missing(poses, why):
    with pytest.raises(CalibrationError, match=why):
        calibrate(seen_by(mounted([0, 0, 0], [0, 0, 0]), poses))


def test_views_that_do_not_fit_each_other_make_it_uncertain():
    rng = np.random.default_rng(3)

    def anywhere(index):
        return transform_from(Rotation.random(rng=rng).as_matrix(), rng.normal(0, 0.2, 3))

    found = calibrate(seen_by(mounted([0, 0, 0], [0, 0, 0]), cameras(8), anywhere))
    assert found.position_std_m > 0.02
    assert found.turn_std_deg > 5
    assert found.middle_px > 2


def test_corners_are_found_where_they_are_in_a_picture():
    [pose] = cameras(1, seed=4)
    corners, pixels = CornerFinder(BOARD).find(picture(pose, np.random.default_rng(0)))
    assert len(corners) == 8 * 5
    expected = OAK_D.project(transform_points(invert(pose) @ BASE_FROM_BOARD, corners))
    assert np.linalg.norm(pixels - expected, axis=1).max() < 0.5
    assert np.linalg.norm(pixels - expected, axis=1).mean() < 0.15


def test_half_a_board_will_do_and_none_gives_none():
    [pose] = cameras(1, seed=4)
    seen = picture(pose)
    seen[:, :640] = 127
    assert 6 <= len(CornerFinder(BOARD).find(seen)[0]) < 40
    corners, pixels = CornerFinder(BOARD).find(np.full((80, 120, 3), 90, np.uint8))
    assert corners.shape == (0, 3)
    assert pixels.shape == (0, 2)


def test_a_drawn_board_is_found():
    seen = np.repeat(drawn(BOARD)[..., None], 3, axis=2)
    assert len(CornerFinder(BOARD).find(seen)[0]) == 8 * 5


@pytest.mark.parametrize(
    ("changes", "why"),
    [
        ({"columns": 2}, "a board of 2x6 squares"),
        ({"columns": 3, "rows": 3}, "3x3 squares has 4 inner corners: 6 are needed"),
        ({"rows": 41}, "a board of 9x41 squares"),
        ({"marker_m": 0.03}, "markers are smaller"),
        ({"square_m": 30.0, "marker_m": 22.0}, "in metres"),
        ({"square_m": float("nan")}, "in metres"),
        ({"dictionary": "5X5"}, "choose one of 4X4_50"),
        ({"columns": 20, "rows": 20}, "more than the 100 markers"),
    ],
)
def test_what_is_no_board_is_refused(changes, why):
    fields = {"columns": 9, "rows": 6, "square_m": 0.03, "marker_m": 0.022}
    with pytest.raises(UsageError, match=why):
        Board(**fields | changes)
