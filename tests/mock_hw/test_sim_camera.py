"""The simulated camera sees from where the arm really is."""

import itertools
import threading
import time
from dataclasses import replace

import numpy as np
import pytest
from contracts.arm import down, linear
from contracts.camera import CameraContract

from canopy_skel.document import to_json
from canopy_skel.errors import UsageError
from canopy_skel.geometry import invert
from drivers.errors import CameraTimeoutError
from drivers.protocols import ToolPose, wait_settled
from drivers.ur5.arm import Ur5Arm
from drivers.ur5.messages import Ur5Config
from mock_hw.orchard.path import OAK_D, TOOL_FROM_CAMERA
from mock_hw.orchard.simulate import Options, prepare, truth, views
from mock_hw.sim_camera import SimCamera

SCALE = 0.125


@pytest.fixture(scope="module")
def simulation():
    return prepare(Options(leaf_count=150, rows=False, seed=7))


@pytest.fixture(scope="module")
def exact():
    return prepare(Options(leaf_count=150, rows=False, seed=7, noise="none"))


class Flange:
    """A flange that stands where a test puts it."""

    def __init__(self, base_from_tool0):
        self.base_from_tool0 = base_from_tool0

    def pose(self):
        return ToolPose(stamp_ns=time.monotonic_ns(), base_from_tool0=self.base_from_tool0)


def tool_at(base_from_camera):
    return base_from_camera @ invert(TOOL_FROM_CAMERA)


@pytest.fixture
def flange(simulation):
    return Flange(tool_at(simulation.true_poses[0]))


class TestSimCamera(CameraContract):
    @pytest.fixture
    def make_camera(self, flange, simulation):
        return lambda: SimCamera(flange.pose, simulation, scale=SCALE)

    @pytest.fixture
    def make_blind_camera(self, flange, simulation):
        stale = flange.pose()
        return lambda: SimCamera(lambda: stale, simulation, scale=SCALE)


def bytes_of(image):
    return (
        image.color_rgb.tobytes(),
        image.depth_m.tobytes(),
        image.instances.tobytes(),
        image.scores,
        image.intrinsics,
    )


def test_the_same_pose_and_exposure_number_give_the_same_picture(flange, simulation):
    runs = []
    for _ in range(2):
        with SimCamera(flange.pose, simulation, scale=SCALE) as camera:
            runs.append([bytes_of(camera.grab(10.0)) for _ in range(2)])
    assert runs[0] == runs[1]
    assert runs[0][0] != runs[0][1]


def test_along_the_path_of_the_simulation_it_sees_the_same_scan_and_truth(exact):
    small = SimCamera(lambda: None, exact, scale=SCALE)._camera
    expected = replace(exact, options=replace(exact.options, camera=small))
    flange = Flange(tool_at(exact.true_poses[0]))
    with SimCamera(flange.pose, exact, scale=SCALE) as camera:
        for pose, view in zip(exact.true_poses, views(expected), strict=True):
            flange.base_from_tool0 = tool_at(pose)
            image = camera.grab(10.0)
            same = (image.depth_m == view.depth_m) | np.isnan(image.depth_m)
            assert same.mean() > 0.999
            assert (image.instances == view.instances).mean() > 0.999
        seen = camera.truth()
    wanted = truth(expected)
    assert seen.position.tobytes() == wanted.position.tobytes()
    assert seen.extra["framed"] == wanted.extra["framed"]
    assert np.mean(seen.occluded != wanted.occluded) < 0.01
    assert seen.views_used == 10


def test_truth_counts_only_the_pictures_that_were_kept(exact):
    flange = Flange(tool_at(exact.true_poses[0]))
    with SimCamera(flange.pose, exact, scale=SCALE) as camera:
        first = camera.grab(10.0)
        one_view = camera.truth()
        flange.base_from_tool0 = tool_at(exact.true_poses[7])
        camera.grab(10.0)
    assert to_json(camera.truth({first.stamp_ns})) == to_json(one_view)
    assert camera.truth().occluded.sum() < one_view.occluded.sum()
    assert camera.truth().views_used == 2


def test_the_picture_is_of_the_pose_at_its_stamp(exact):
    """An arm that moves on while the picture is drawn does not change it."""
    poses = {}
    ticks = itertools.count()

    def moving():
        pose = exact.true_poses[0].copy()
        pose[1, 3] += 0.01 * next(ticks)
        stamp_ns = time.monotonic_ns()
        poses[stamp_ns] = pose
        return ToolPose(stamp_ns=stamp_ns, base_from_tool0=tool_at(pose))

    with SimCamera(moving, exact, scale=SCALE) as camera:
        images = [camera.grab(10.0) for _ in range(3)]
    for image, exposure in zip(images, camera.exposures, strict=True):
        assert exposure.stamp_ns == image.stamp_ns
        assert exposure.base_from_camera == pytest.approx(poses[image.stamp_ns], abs=1e-12)


def test_the_believed_hand_eye_differs_from_the_true_one_as_simulated(simulation):
    flange = Flange(tool_at(simulation.true_poses[0]))
    with SimCamera(flange.pose, simulation, scale=SCALE) as camera:
        for _ in range(5):
            camera.grab(10.0)
    offsets_m = [
        np.linalg.norm((one.base_from_camera - simulation.true_poses[0])[:3, 3])
        for one in camera.exposures
    ]
    assert 0 < max(offsets_m) < 0.003
    assert len(set(offsets_m)) == 5


def test_a_picture_that_is_not_drawn_in_time_does_not_come_later(flange, simulation):
    with SimCamera(flange.pose, simulation, scale=0.5) as camera:
        with pytest.raises(CameraTimeoutError, match="not drawn within"):
            camera.grab(0.01)
        called_ns = time.monotonic_ns()
        assert camera.grab(20.0).stamp_ns > called_ns


def test_others_can_run_while_it_draws(flange, simulation):
    """A stop must not wait for a picture: drawing leaves the interpreter to other threads."""
    with SimCamera(flange.pose, simulation) as camera:
        drawing = threading.Thread(target=camera.grab, args=(60.0,))
        drawing.start()
        longest_s, last_s = 0.0, time.perf_counter()
        while drawing.is_alive():
            time.sleep(0.002)
            now_s = time.perf_counter()
            longest_s, last_s = max(longest_s, now_s - last_s), now_s
        drawing.join()
    assert longest_s < 0.25


def test_on_the_arm_it_sees_from_where_the_controller_says(fake, exact):
    pytest.importorskip("rtde_control", reason="ur-rtde has no wheel for this Python")
    fake.do("home")
    with (
        Ur5Arm(Ur5Config(host=fake.host, script_timeout_s=0.5)) as arm,
        SimCamera(lambda: arm.state().pose, exact, scale=SCALE) as camera,
    ):
        for _ in range(3):
            arm.start_move(linear(down(arm.state(), 0.1)))
            state = wait_settled(arm, timeout_s=10.0)
            camera.grab(10.0)
            expected = state.pose.base_from_tool0 @ TOOL_FROM_CAMERA
            assert camera.exposures[-1].base_from_camera == pytest.approx(expected, abs=1e-6)


def test_a_smaller_picture_shows_the_same(flange, exact):
    with SimCamera(flange.pose, exact, scale=0.25) as camera:
        image = camera.grab(20.0)
    lens = image.intrinsics
    assert (lens.width_px, lens.height_px) == (320, 200)
    for corner_px, full_px in ((-0.5, -0.5), (319.5, 1279.5)):
        ray = (corner_px - lens.cx_px) / lens.fx_px
        assert ray == pytest.approx((full_px - OAK_D.cx_px) / OAK_D.fx_px)


@pytest.mark.parametrize("scale", [0.0, -1.0])
def test_a_picture_without_pixels_is_refused(flange, simulation, scale):
    with pytest.raises(UsageError, match="no pictures scaled by"):
        SimCamera(flange.pose, simulation, scale=scale)
