"""The replayed rig: a recording one can drive around in."""

import time
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from contracts.arm import ArmContract, linear
from contracts.camera import CameraContract, FailingOpenContract, arrays_of

from canopy_skel.errors import UsageError
from canopy_skel.frame import Intrinsics, View
from canopy_skel.geometry import invert
from canopy_skel.recording import RecordingWriter, read_recording
from drivers import kinematics
from drivers.errors import CameraTimeoutError, UnreachableError
from drivers.protocols import wait_settled
from mock_hw.orchard.path import TOOL_FROM_CAMERA
from mock_hw.replay import ReplayArm, ReplayCamera, read_track

HOME = kinematics.forward([0.0, -np.pi / 2, np.pi / 2, -np.pi / 2, -np.pi / 2, 0.0])
TURN = [0.2, -0.1, 0.15, 0.1, -0.2, 0.4]
LENS = Intrinsics(fx_px=30.0, fy_px=30.0, cx_px=15.5, cy_px=9.5, width_px=32, height_px=20)
DEMO = Path(__file__).parents[2] / "recordings/demo_apple.mcap"


def record(path, tool_poses):
    """Write a recording with a tiny view from each pose of the flange; view i is all grey 10 i."""
    with RecordingWriter(path, {"scan_id": "s"}, tool_from_camera=TOOL_FROM_CAMERA) as writer:
        for index, pose in enumerate(tool_poses):
            view = View(
                index=index,
                stamp_ns=1_000_000_000 * (index + 1),
                color_rgb=np.full((20, 32, 3), 10 * index, np.uint8),
                intrinsics=LENS,
                base_from_camera=pose @ TOOL_FROM_CAMERA,
                depth_m=np.full((20, 32), 1.0 + index, np.float32),
            )
            writer.write_view(view)
    return read_recording(path)


def below(way_m):
    pose = HOME.copy()
    pose[2, 3] -= way_m
    return pose


@pytest.fixture
def track(tmp_path):
    turned = kinematics.forward(kinematics.inverse(HOME, np.zeros(6)) + TURN)
    poses = [below(way_m) for way_m in (0.0, 0.05, 0.1, 0.2, 0.25)]
    return read_track(record(tmp_path / "grid.mcap", [*poses, turned]))


@pytest.fixture(scope="module")
def demo():
    return read_track(read_recording(DEMO))


class TestReplayArm(ArmContract):
    @pytest.fixture
    def make_arm(self, track):
        return lambda: ReplayArm(track, time_scale=10)


class TestReplayCamera(CameraContract, FailingOpenContract):
    @pytest.fixture
    def recording_path(self, tmp_path):
        path = tmp_path / "demo.mcap"
        path.write_bytes(DEMO.read_bytes())
        return path

    @pytest.fixture
    def copied(self, recording_path):
        return read_track(read_recording(recording_path))

    @pytest.fixture
    def arm(self, copied):
        with ReplayArm(copied, time_scale=10) as arm:
            yield arm

    @pytest.fixture
    def make_camera(self, copied, arm):
        return lambda: ReplayCamera(copied, arm.pose)

    @pytest.fixture
    def make_blind_camera(self, copied, arm):
        arm.start_move(linear(copied.stations[2].base_from_tool0, speed_mps=0.02))
        time.sleep(0.3)
        arm.stop()
        return lambda: ReplayCamera(copied, arm.pose)

    @pytest.fixture
    def absent(self, recording_path):
        @contextmanager
        def gone():
            kept = recording_path.rename(recording_path.with_suffix(".away"))
            yield
            kept.rename(recording_path)

        return gone


def test_the_views_of_a_recording_come_back_unchanged_from_where_they_were_taken(demo):
    views = list(demo.recording.views())
    with ReplayArm(demo, time_scale=1000) as arm, ReplayCamera(demo, arm.pose) as camera:
        for station, view in zip(demo.stations, views, strict=True):
            arm.start_move(linear(station.base_from_tool0))
            state = wait_settled(arm, timeout_s=5.0)
            image = camera.grab(1.0)
            seen_from = state.pose.base_from_tool0 @ demo.tool_from_camera
            assert seen_from == pytest.approx(view.base_from_camera, abs=1e-12)
            assert image.intrinsics == view.intrinsics
            assert image.scores == view.scores
            for replayed, recorded in zip(arrays_of(image), arrays_of(view), strict=True):
                assert replayed.tobytes() == recorded.tobytes()


def test_the_stereo_pair_comes_back_too(shared_recording):
    track = read_track(read_recording(shared_recording("walnut_stereo")))
    view = track.recording.view(track.stations[0].index)
    with ReplayArm(track) as arm, ReplayCamera(track, arm.pose) as camera:
        pair = camera.grab(5.0).stereo
    assert pair.left_mono.tobytes() == view.stereo.left_mono.tobytes()
    assert pair.right_mono.tobytes() == view.stereo.right_mono.tobytes()
    assert pair.baseline_m == view.stereo.baseline_m


def test_a_place_off_the_track_is_refused_and_the_nearest_view_named(demo):
    pose = demo.stations[1].base_from_tool0.copy()
    pose[0, 3] += 0.02
    with (
        ReplayArm(demo) as arm,
        pytest.raises(UnreachableError, match=r"is view \d, 0\.020 m away"),
    ):
        arm.start_move(linear(pose))


def test_between_two_views_there_is_no_picture_and_the_way_out_is_told(track):
    with ReplayArm(track) as arm, ReplayCamera(track, arm.pose) as camera:
        arm.start_move(linear(below(0.25), speed_mps=0.2))
        time.sleep(0.12)
        arm.stop()
        with pytest.raises(CameraTimeoutError, match=r"view \d is 0\.0\d+ m away: move it there"):
            camera.grab(0.1)


def test_a_picture_waits_for_the_arm_to_arrive(track):
    with ReplayArm(track) as arm, ReplayCamera(track, arm.pose) as camera:
        arm.start_move(linear(below(0.05), speed_mps=0.1))
        while np.allclose(arm.pose().base_from_tool0, HOME, atol=2e-3):
            time.sleep(0.01)
        assert camera.grab(3.0).color_rgb[0, 0, 0] == 10


def test_the_arm_moves_at_the_commanded_speed(track):
    with ReplayArm(track, time_scale=2) as arm:
        started = time.perf_counter()
        arm.start_move(linear(below(0.2), speed_mps=0.2))
        assert arm.state().tool_speed_mps == pytest.approx(0.4)
        wait_settled(arm, timeout_s=5.0)
        assert 0.5 <= time.perf_counter() - started < 0.8


def test_views_from_one_place_come_in_turn(tmp_path):
    track = read_track(record(tmp_path / "burst.mcap", [HOME, HOME, below(0.1)]))
    with ReplayArm(track) as arm, ReplayCamera(track, arm.pose) as camera:
        greys = [int(camera.grab(1.0).color_rgb[0, 0, 0]) for _ in range(4)]
    assert greys == [0, 10, 0, 10]


def test_without_a_flange_in_the_recording_the_camera_takes_its_place(tmp_path):
    recording = record(tmp_path / "hand_held.mcap", [HOME])
    options = recording.options
    lost = read_recording(recording.path, topics=type(options)(tool_frame="wrist"))
    track = read_track(lost)
    assert np.array_equal(track.tool_from_camera, np.eye(4))
    assert track.stations[0].base_from_tool0 == pytest.approx(HOME @ TOOL_FROM_CAMERA, abs=1e-9)
    assert read_track(recording).tool_from_camera == pytest.approx(TOOL_FROM_CAMERA, abs=1e-9)


def test_places_out_of_a_ur5s_reach_can_be_replayed(tmp_path):
    far = HOME.copy()
    far[0, 3] += 5.0
    farther = far.copy()
    farther[1, 3] += 0.1
    track = read_track(record(tmp_path / "far.mcap", [far, farther]))
    with ReplayArm(track, time_scale=100) as arm:
        assert np.isnan(arm.state().joints_rad).all()
        arm.start_move(linear(farther))
        end = wait_settled(arm, timeout_s=3.0)
    assert end.pose.base_from_tool0 == pytest.approx(farther)


def test_a_time_scale_that_is_none_is_refused(track):
    with pytest.raises(UsageError, match="time_scale is 0"):
        ReplayArm(track, time_scale=0)


def test_one_view_alone_is_the_view_of_the_whole(demo):
    for view in demo.recording.views():
        alone = demo.recording.view(view.index)
        assert alone.stamp_ns == view.stamp_ns
        assert invert(alone.base_from_camera) @ view.base_from_camera == pytest.approx(np.eye(4))
        assert alone.color_rgb.tobytes() == view.color_rgb.tobytes()
