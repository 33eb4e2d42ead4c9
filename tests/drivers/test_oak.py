"""OakCamera at the level of its pipe, with a child that misbehaves; and against depthai itself."""

import os
import signal
import sys
import threading
import time
from contextlib import contextmanager
from datetime import timedelta
from pathlib import Path

import numpy as np
import pytest
from contracts.camera import CameraContract, FailingOpenContract

from drivers.errors import CameraTimeoutError, NoCameraError
from drivers.oak.camera import OakCamera
from drivers.oak.frames import Exposure
from drivers.oak.messages import OakConfig

QUICK = OakConfig(open_timeout_s=10.0, silence_s=0.5)
CHILD = Path(__file__).parent / "fake_oak_child.py"
STAGED = CHILD.with_name("oak_child_on_stage.py")


@pytest.fixture
def behaviour(tmp_path):
    """Writes how the fake child shall behave from now on."""
    path = tmp_path / "behaviour"
    path.write_text("well")
    return path


@pytest.fixture
def make_camera(behaviour):
    return lambda: OakCamera(QUICK, (sys.executable, str(CHILD), str(behaviour)))


class TestOakCamera(CameraContract, FailingOpenContract):
    @pytest.fixture
    def make_blind_camera(self, behaviour, make_camera):
        behaviour.write_text("silent")
        return make_camera

    @pytest.fixture
    def absent(self, behaviour):
        @contextmanager
        def gone():
            behaviour.write_text("absent")
            yield
            behaviour.write_text("well")

        return gone


@pytest.fixture
def on_stage(behaviour):
    """The real child and the real depthai, but for the device."""
    pytest.importorskip("depthai", reason="needs the extra: pip install 'canopy-skel[oak]'")
    command = (sys.executable, str(STAGED), str(behaviour))
    return lambda eye: OakCamera(OakConfig(eye=eye), command)


def test_the_color_camera_comes_without_a_pair(on_stage):
    with on_stage("color") as camera:
        called_ns = time.monotonic_ns()
        image = camera.grab(5.0)
    assert image.stereo is None
    assert image.stamp_ns >= called_ns
    assert image.depth_m == pytest.approx(0.1)
    assert image.intrinsics.fx_px == 80.0


class TestOakChildOnStage(CameraContract):
    @pytest.fixture
    def make_camera(self, on_stage):
        return lambda: on_stage("left")

    @pytest.fixture
    def make_blind_camera(self, behaviour, make_camera):
        behaviour.write_text("dark")
        return make_camera

    def test_the_left_eye_has_the_right_one_beside_it(self, camera):
        pair = camera.grab(5.0).stereo
        assert pair.baseline_m == pytest.approx(0.075)
        assert pair.intrinsics.fx_px == 80.0

    def test_a_device_that_is_lost_is_opened_again(self, behaviour, camera):
        camera.grab(5.0)
        pid = camera.pid
        behaviour.write_text("lost-once")
        camera.grab(10.0)
        assert camera.pid != pid

    def test_a_device_that_stays_away_is_named(self, behaviour, camera):
        behaviour.write_text("lost")
        time.sleep(0.1)
        with pytest.raises(NoCameraError, match="the device was lost: check cable and power"):
            camera.grab(0.2)


@pytest.mark.hardware
class TestRealOakColor(CameraContract):
    eye = "color"

    @pytest.fixture
    def make_camera(self):
        return lambda: OakCamera(OakConfig(eye=self.eye))

    @pytest.fixture
    def make_blind_camera(self):
        pytest.skip("a real camera cannot be blinded from here")


@pytest.mark.hardware
class TestRealOakLeft(TestRealOakColor):
    eye = "left"


@pytest.mark.parametrize("how", ["die-once", "hang-once", "unplugged-once", "half-once"])
def test_a_child_that_fails_is_replaced_within_the_grab(behaviour, make_camera, how):
    with make_camera() as camera:
        first = camera.grab(5.0)
        behaviour.write_text(how)
        assert camera.grab(5.0).stamp_ns > first.stamp_ns


@pytest.mark.parametrize(
    ("how", "says"),
    [
        ("die", r"died \(exit code 7\)"),
        ("hang", "silent for 0.5 s: it hangs"),
        ("unplugged", "Couldn't read data"),
        ("half", r"died \(exit code -9\)"),
    ],
)
def test_a_child_that_keeps_failing_is_named_and_the_next_grab_tries_again(
    behaviour, make_camera, how, says
):
    with make_camera() as camera:
        behaviour.write_text(how)
        started = time.perf_counter()
        with pytest.raises(NoCameraError, match=says):
            camera.grab(0.7)
        assert time.perf_counter() - started < 0.7 + 0.8
        behaviour.write_text("well")
        camera.grab(5.0)


def test_a_hanging_child_is_found_out_by_grabs_shorter_than_its_patience(behaviour, make_camera):
    with make_camera() as camera:
        behaviour.write_text("hang")
        with pytest.raises(CameraTimeoutError):
            camera.grab(0.2)
        with pytest.raises(NoCameraError, match="hangs"):
            camera.grab(0.4)


def test_a_child_killed_between_two_grabs_is_not_noticed_by_the_second(make_camera):
    with make_camera() as camera:
        camera.grab(5.0)
        os.kill(camera.pid, signal.SIGKILL)
        camera.grab(5.0)


def test_a_camera_that_goes_and_comes_while_nobody_grabs_is_noticed(behaviour, make_camera):
    with make_camera() as camera:
        camera.check()
        behaviour.write_text("absent")
        os.kill(camera.pid, signal.SIGKILL)
        wait_for(lambda: refusal(camera) == "the camera's process died (exit code -9)")
        wait_for(lambda: refusal(camera) == "no OAK camera found: check cable")
        behaviour.write_text("well")
        wait_for(lambda: refusal(camera) is None)
        camera.grab(5.0)


def refusal(camera):
    """Why the camera cannot be used, found out without waiting."""
    asked = time.perf_counter()
    try:
        camera.check()
    except NoCameraError as error:
        return str(error)
    finally:
        assert time.perf_counter() - asked < 0.5
    return None


def wait_for(condition, timeout_s=10.0):
    until = time.perf_counter() + timeout_s
    while not condition():
        assert time.perf_counter() < until
        time.sleep(0.02)


def test_a_stopped_child_is_replaced(make_camera):
    with make_camera() as camera:
        camera.grab(5.0)
        os.kill(camera.pid, signal.SIGSTOP)
        camera.grab(5.0)


def test_a_picture_that_comes_too_late_is_not_given_to_the_next(behaviour, make_camera):
    with make_camera() as camera:
        behaviour.write_text("late-once")
        with pytest.raises(CameraTimeoutError):
            camera.grab(0.1)
        time.sleep(0.8)
        called_ns = time.monotonic_ns()
        assert camera.grab(5.0).stamp_ns > called_ns


def test_leaving_ends_a_grab_of_another_thread_and_the_child(behaviour, make_camera):
    behaviour.write_text("silent")
    camera = make_camera()
    with camera:
        pid = camera.pid
        timer = threading.Timer(0.3, camera.__exit__, (None, None, None))
        timer.start()
        started = time.perf_counter()
        with pytest.raises(NoCameraError, match="with"):
            camera.grab(20.0)
        assert time.perf_counter() - started < 2.0
        timer.join()
    with pytest.raises(ProcessLookupError):
        os.kill(pid, 0)


def test_a_child_that_dies_at_once_is_said(behaviour, make_camera):
    behaviour.write_text("dead on arrival")
    with pytest.raises(NoCameraError, match=r"died \(exit code 3\)"), make_camera():
        pass


# Against depthai: there is no device here, but there is the library.


@pytest.fixture
def dai():
    return pytest.importorskip("depthai", reason="needs the extra: pip install 'canopy-skel[oak]'")


def test_without_a_device_it_says_so_within_a_second(dai):
    """Half of that second is depthai's search; a busy machine gets a few tries."""
    if dai.Device.getAllAvailableDevices():
        pytest.skip("there is an OAK here")
    took_s = []
    while not took_s or (min(took_s) > 1.0 and len(took_s) < 6):
        started = time.perf_counter()
        with pytest.raises(NoCameraError, match="no OAK camera found"), OakCamera():
            pass
        took_s.append(time.perf_counter() - started)
    assert min(took_s) < 1.0


def test_without_depthai_it_says_how_to_get_it(tmp_path, monkeypatch):
    (tmp_path / "depthai.py").write_text("raise ModuleNotFoundError(\"No module named 'depthai'\")")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(NoCameraError, match=r"pip install 'canopy-skel\[oak\]'"), OakCamera():
        pass


@pytest.mark.parametrize(
    ("name", "says"),
    [("", "several OAK cameras: A1 .*, B2 .*; name one"), ("C3", "no OAK camera 'C3'; there are")],
)
def test_with_several_devices_one_must_be_named(tmp_path, monkeypatch, name, says):
    (tmp_path / "depthai.py").write_text(
        "from types import SimpleNamespace as N\n"
        "found = [N(deviceId='A1', name='1.1'), N(deviceId='B2', name='10.0.0.9')]\n"
        "Device = N(getAllAvailableDevices=lambda: found)\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(NoCameraError, match=says), OakCamera(OakConfig(device=name)):
        pass


def frame(dai, pixels, kind, at_s, matrix=None):
    one = dai.ImgFrame()
    one.setCvFrame(pixels, kind)
    one.setTimestamp(timedelta(seconds=at_s))
    if matrix is not None:
        height, width = pixels.shape[:2]
        one.setTransformation(dai.ImgTransformation(width, height, matrix))
    return one


MATRIX = [[800.0, 0.0, 31.0], [0.0, 801.0, 19.0], [0.0, 0.0, 1.0]]


def test_frames_of_the_color_camera_become_a_picture(dai):
    blue_first = np.zeros((40, 64, 3), np.uint8)
    blue_first[..., 0] = 200
    millimetres = np.full((40, 64), 1500, np.uint16)
    millimetres[0, 0] = 0
    exposure = Exposure(
        frames={
            "color": frame(dai, blue_first, dai.ImgFrame.Type.RGB888i, 12.5, MATRIX),
            "depth": frame(dai, millimetres, dai.ImgFrame.Type.RAW16, 12.49),
        },
        baseline_m=0.075,
    )
    image = exposure.image()
    assert exposure.began_ns == 12_490_000_000
    assert image.stamp_ns == 12_500_000_000
    assert image.color_rgb[0, 0].tolist() == [0, 0, 200]
    assert np.isnan(image.depth_m[0, 0])
    assert image.depth_m[1:] == pytest.approx(1.5)
    lens = image.intrinsics
    assert (lens.fx_px, lens.fy_px, lens.cx_px, lens.cy_px) == (800.0, 801.0, 31.0, 19.0)
    assert (lens.width_px, lens.height_px) == (64, 40)
    assert image.stereo is None


def test_frames_of_the_stereo_cameras_become_a_picture_with_its_pair(dai):
    grey = np.full((40, 64), 70, np.uint8)
    exposure = Exposure(
        frames={
            "left": frame(dai, grey, dai.ImgFrame.Type.GRAY8, 3.0, MATRIX),
            "right": frame(dai, grey + 1, dai.ImgFrame.Type.GRAY8, 3.0, MATRIX),
            "depth": frame(dai, np.full((40, 64), 900, np.uint16), dai.ImgFrame.Type.RAW16, 3.0),
        },
        baseline_m=0.075,
    )
    image = exposure.image()
    assert image.color_rgb[5, 5].tolist() == [70, 70, 70]
    assert image.stereo.right_mono[5, 5] == 71
    assert image.stereo.intrinsics == image.intrinsics
    assert image.stereo.baseline_m == 0.075


def test_a_covered_lens_gives_a_picture_without_depth(dai):
    exposure = Exposure(
        frames={
            "color": frame(
                dai, np.zeros((40, 64, 3), np.uint8), dai.ImgFrame.Type.RGB888i, 1.0, MATRIX
            ),
            "depth": frame(dai, np.zeros((40, 64), np.uint16), dai.ImgFrame.Type.RAW16, 1.0),
        },
        baseline_m=0.075,
    )
    assert np.isnan(exposure.image().depth_m).all()


def test_depth_of_another_size_or_a_device_without_calibration_is_refused(dai):
    color = np.zeros((40, 64, 3), np.uint8)
    depth = frame(dai, np.zeros((20, 32), np.uint16), dai.ImgFrame.Type.RAW16, 1.0)
    kind = dai.ImgFrame.Type.RGB888i
    frames = {"color": frame(dai, color, kind, 1.0, MATRIX), "depth": depth}
    with pytest.raises(ValueError, match="depth is 32x20 but colour is 64x40"):
        Exposure(frames=frames, baseline_m=0.1).image()
    frames["depth"] = frame(dai, np.zeros((40, 64), np.uint16), dai.ImgFrame.Type.RAW16, 1.0)
    frames["color"] = frame(dai, color, kind, 1.0)
    with pytest.raises(ValueError, match="is the device calibrated"):
        Exposure(frames=frames, baseline_m=0.1).image()
