"""Ur5Arm, ur-rtde and all, against the fake controller."""

import time
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from contracts.arm import ArmContract, assert_stands_still, down, linear

from drivers import kinematics
from drivers.errors import (
    ArmBusyError,
    ControllerFrozenError,
    MoveInterruptedError,
    MoveRefusedError,
    NotConnectedError,
)
from drivers.protocols import wait_settled
from drivers.ur5.arm import Ur5Arm
from drivers.ur5.messages import Ur5Config


class TestUr5Arm(ArmContract):
    pass


def test_no_controller_there_is_said_at_once():
    started = time.perf_counter()
    with (
        pytest.raises(NotConnectedError, match=r"no UR controller at 127\.0\.0\.1, port 29999"),
        Ur5Arm(Ur5Config(host="127.0.0.1")),
    ):
        pass
    assert time.perf_counter() - started < 2.0


def test_a_frozen_controller_is_said_soon(fake, make_arm):
    fake.do("freeze")
    started = time.perf_counter()
    with pytest.raises(ControllerFrozenError, match="does not answer on port 29999"), make_arm():
        pass
    assert time.perf_counter() - started < 3.0


def test_pose_joints_and_stamp_are_of_one_instant(make_arm):
    with make_arm() as arm:
        arm.start_move(linear(down(arm.state(), 0.2), speed_mps=0.02))
        for _ in range(100):
            state = arm.state()
            reached = kinematics.forward(state.joints_rad)
            assert state.pose.base_from_tool0 == pytest.approx(reached, abs=1e-9)
            time.sleep(0.003)


def test_payload_tool_and_watchdog_are_set_before_the_first_move(fake, make_arm):
    fake.do("set_tcp", x=0.0, y=0.0, z=0.1)
    with make_arm() as arm:
        before = arm.state()
        flange = kinematics.forward(before.joints_rad)
        assert before.pose.base_from_tool0 == pytest.approx(flange, abs=1e-9)
        target = down(before, 0.05)
        arm.start_move(linear(target))
        end = wait_settled(arm, timeout_s=5.0)
        state = fake.do("state")
    assert end.pose.base_from_tool0 == pytest.approx(target, abs=1e-6)
    assert kinematics.forward(end.joints_rad) == pytest.approx(target, abs=1e-6)
    assert state["payload_kg"] == 0.6
    assert state["watchdog"]


def test_leaving_ends_the_program_and_lets_others_in(fake, make_arm):
    for _ in range(2):
        with make_arm() as arm:
            arm.start_move(linear(down(arm.state(), 0.02)))
            wait_settled(arm, timeout_s=5.0)
        assert fake.do("state")["runtime_state"] == "STOPPED"


def test_a_move_right_after_a_soft_stop_waits_for_the_rest(fake):
    config = Ur5Config(host=fake.host, stop_deceleration_mps2=0.05)
    with Ur5Arm(config) as arm:
        start = arm.state()
        arm.start_move(linear(down(start, 0.4)))
        while arm.state().tool_speed_mps < 0.2:
            time.sleep(0.001)
        for _ in range(3):
            arm.stop()
        arm.start_move(linear(start.pose.base_from_tool0))
        end = wait_settled(arm, timeout_s=5.0)
    assert end.pose.base_from_tool0 == pytest.approx(start.pose.base_from_tool0, abs=1e-6)


def test_a_stop_before_the_move_has_begun_prevents_it(make_arm):
    with make_arm() as arm, ThreadPoolExecutor(1) as pool:
        uploading = pool.submit(arm.start_move, linear(down(arm.state(), 0.2)))
        time.sleep(0.02)
        arm.stop()
        with pytest.raises(MoveInterruptedError, match="before the move began"):
            uploading.result()
        assert_stands_still(arm)


def test_two_threads_cannot_begin_two_moves(make_arm):
    with make_arm() as arm, ThreadPoolExecutor(4) as pool:
        target = down(arm.state(), 0.2)

        def begin():
            try:
                arm.start_move(linear(target, speed_mps=0.05))
            except ArmBusyError:
                return False
            return True

        begun = [future.result() for future in [pool.submit(begin) for _ in range(4)]]
        assert begun.count(True) == 1
        wait_settled(arm, timeout_s=5.0)


def test_numbers_beyond_the_robot_are_refused(make_arm):
    with make_arm() as arm:
        with pytest.raises(MoveRefusedError, match="does not take such numbers"):
            arm.start_move(linear(down(arm.state(), 0.05), speed_mps=50.0))
        arm.start_move(linear(down(arm.state(), 0.05)))
        wait_settled(arm, timeout_s=5.0)


def test_seventy_waypoints_take_little_more_than_their_motion(make_arm):
    with make_arm() as arm:
        start = arm.state().pose.base_from_tool0
        began = time.perf_counter()
        for row, column in ((row, column) for row in range(10) for column in range(7)):
            target = start.copy()
            target[1, 3] += 0.05 * (column if row % 2 == 0 else 6 - column)
            target[2, 3] -= 0.025 * row
            arm.start_move(linear(target))
            end = wait_settled(arm, timeout_s=5.0)
            assert np.abs(end.pose.base_from_tool0 - target).max() < 1e-6
        took_s = time.perf_counter() - began
    motion_s = 70 * (0.05 / 0.25 + 0.25 / 0.5) / 20
    assert (took_s - motion_s) / 70 < 0.2
