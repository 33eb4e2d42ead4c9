"""What every Camera must do. Subclass it and give the fixtures.

`make_camera()` returns a camera that is not entered yet and has something to see;
`make_blind_camera()` one that opens, but no picture reaches it. A camera that can fail to open is
held to `FailingOpenContract` too, with `absent`, a context manager in which it is not there.
"""

import time

import numpy as np
import pytest

from drivers.errors import CameraTimeoutError, NoCameraError

GRAB_TIMEOUT_S = 10.0
LATE_S = 0.5


def arrays_of(image):
    pair = image.stereo
    sides = () if pair is None else (pair.left_mono, pair.right_mono)
    parts = (image.color_rgb, image.depth_m, image.instances, *sides)
    return [array for array in parts if array is not None]


class CameraContract:
    @pytest.fixture
    def camera(self, make_camera):
        with make_camera() as camera:
            yield camera

    def test_outside_its_block_it_says_so(self, make_camera):
        camera = make_camera()
        for asked in (lambda: camera.grab(1.0), camera.check):
            with pytest.raises(NoCameraError, match="with"):
                asked()
            with camera:
                camera.check()
                camera.grab(GRAB_TIMEOUT_S)
                camera.check()
            with pytest.raises(NoCameraError, match="with"):
                asked()

    def test_it_can_be_entered_again(self, make_camera):
        camera = make_camera()
        for _ in range(2):
            with camera:
                camera.grab(GRAB_TIMEOUT_S)

    def test_leaving_twice_is_harmless(self, make_camera):
        camera = make_camera()
        camera.__exit__(None, None, None)
        with camera:
            pass
        camera.__exit__(None, None, None)

    def test_stamps_increase_and_lie_between_call_and_return(self, camera):
        newest_ns = 0
        for _ in range(4):
            called_ns = time.monotonic_ns()
            stamp_ns = camera.grab(GRAB_TIMEOUT_S).stamp_ns
            assert called_ns <= stamp_ns <= time.monotonic_ns()
            assert stamp_ns > newest_ns
            newest_ns = stamp_ns

    def test_the_parts_of_a_picture_fit_each_other(self, camera):
        image = camera.grab(GRAB_TIMEOUT_S)
        lens = image.intrinsics
        assert image.color_rgb.shape == (lens.height_px, lens.width_px, 3)
        assert image.color_rgb.dtype == np.uint8
        assert 0 < lens.cx_px < lens.width_px
        assert 0 < lens.cy_px < lens.height_px
        assert image.depth_m is not None or image.stereo is not None
        if image.depth_m is not None:
            assert image.depth_m.shape == image.color_rgb.shape[:2]
            assert image.depth_m.dtype == np.float32
            assert not (image.depth_m <= 0).any()
        if image.stereo is not None:
            assert image.stereo.left_mono.shape == image.stereo.right_mono.shape
            assert 0.01 < image.stereo.baseline_m < 1.0
        if image.instances is not None:
            assert image.instances.shape == image.color_rgb.shape[:2]
            assert image.instances.max() <= len(image.scores)

    def test_nobody_can_change_what_was_seen(self, camera):
        for array in arrays_of(camera.grab(GRAB_TIMEOUT_S)):
            with pytest.raises(ValueError, match="read-only"):
                array[0, 0] = 0

    @pytest.mark.parametrize("timeout_s", [0.0, 0.3])
    def test_without_a_picture_it_gives_up_in_time(self, make_blind_camera, timeout_s):
        with make_blind_camera() as camera:
            for _ in range(2):
                started = time.perf_counter()
                with pytest.raises(CameraTimeoutError):
                    camera.grab(timeout_s)
                assert timeout_s <= time.perf_counter() - started < timeout_s + LATE_S


class FailingOpenContract:
    def test_absent_it_says_so_and_can_be_opened_later(self, make_camera, absent):
        camera = make_camera()
        with absent():
            for _ in range(2):
                with pytest.raises(NoCameraError), camera:
                    pytest.fail("entered a camera that is not there")
            with pytest.raises(NoCameraError):
                camera.grab(0.1)
        with camera:
            camera.grab(GRAB_TIMEOUT_S)
