import numpy as np
import pytest

from canopy_skel.errors import UsageError
from canopy_skel.geometry import invert, is_rigid, transform_points
from mock_hw.orchard.path import OAK_D, TOOL_FROM_CAMERA, camera_path, look_at
from mock_hw.orchard.pose_noise import POSE_NOISE, pose_noise_named, small_transform

SHOULDER = np.array([0.0, 0.0, 0.089])


@pytest.mark.parametrize("views", [10, 70])
def test_paths_are_upright_cameras_that_look_at_the_tree(views):
    poses = camera_path(views)
    assert len(poses) == views
    for pose in poses:
        assert is_rigid(pose)
        right, down = pose[:3, 0], pose[:3, 1]
        assert abs(right[2]) < 1e-9
        assert down[2] < -0.9
        in_camera = transform_points(invert(pose), np.array([[1.70, 0.0, pose[2, 3]]]))
        u, v = OAK_D.project(in_camera)[0]
        assert 0 < u < OAK_D.width_px
        assert 0 < v < OAK_D.height_px
        assert 1.0 < in_camera[0, 2] < 1.55


@pytest.mark.parametrize(("views", "step_m"), [(10, 0.75), (70, 0.21)])
def test_paths_are_serpentine(views, step_m):
    eyes = np.array([pose[:3, 3] for pose in camera_path(views)])
    assert np.linalg.norm(np.diff(eyes, axis=0), axis=1).max() < step_m


def test_ten_views_are_those_of_the_specification():
    poses = camera_path(10)
    eyes = np.array([pose[:3, 3] for pose in poses])
    assert eyes[0] == pytest.approx([0.42 - 0.25 * 0.52**2, -0.52, -0.30])
    assert eyes[7] == pytest.approx([0.42, 0.0, 0.42])
    target = np.array([1.70, 0.35 * -0.52, 0.10 + 0.55 * -0.30])
    ahead = (target - eyes[0]) / np.linalg.norm(target - eyes[0])
    assert poses[0][:3, 2] == pytest.approx(ahead)


@pytest.mark.parametrize(("views", "reach_m"), [(10, 0.75), (70, 0.92)])
def test_the_flange_stays_within_an_arms_length(views, reach_m):
    for pose in camera_path(views):
        flange = (pose @ invert(TOOL_FROM_CAMERA))[:3, 3]
        assert 0.25 < np.linalg.norm(flange - SHOULDER) < reach_m


def test_look_at_puts_the_target_in_the_middle():
    pose = look_at([0.1, -0.4, 0.3], [1.7, 0.2, -0.1])
    x, y, z = transform_points(invert(pose), np.array([[1.7, 0.2, -0.1]]))[0]
    assert (x, y) == pytest.approx((0, 0), abs=1e-12)
    assert z == pytest.approx(np.linalg.norm([1.6, 0.6, -0.4]))


def test_other_numbers_of_views_and_noises_are_refused():
    with pytest.raises(UsageError, match="no camera path with 11 views; choose 10 or 70"):
        camera_path(11)
    with pytest.raises(UsageError, match="unknown noise 'awful'; choose one of none, nominal, bad"):
        pose_noise_named("awful")


def test_pose_noise_has_the_size_it_says(rng):
    noise = POSE_NOISE["nominal"]
    drawn = [small_transform(rng, noise.hand_eye_m, noise.hand_eye_deg) for _ in range(4000)]
    shift = np.array([t[:3, 3] for t in drawn])
    angle = np.degrees(np.arccos([np.clip((np.trace(t[:3, :3]) - 1) / 2, -1, 1) for t in drawn]))
    assert np.sqrt((shift**2).sum(axis=1).mean()) == pytest.approx(0.001, rel=0.05)
    assert np.sqrt((angle**2).mean()) == pytest.approx(0.1, rel=0.05)
    assert all(is_rigid(t) for t in drawn[:50])
    assert np.array_equal(small_transform(rng, 0.0, 0.0), np.eye(4))
