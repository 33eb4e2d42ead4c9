"""What every Arm must do. Subclass it and give a `make_arm` fixture.

`make_arm()` returns an arm that is not entered yet and stands in the same posture each time, with
at least 0.25 m of free way straight down from where the flange is.
"""

import threading
import time

import numpy as np
import pytest

from drivers.errors import (
    ArmBusyError,
    JointLimitError,
    MoveInterruptedError,
    MoveRefusedError,
    NotConnectedError,
    SettleTimeoutError,
    UnreachableError,
)
from drivers.protocols import ArmMode, JointMove, LinearMove, wait_settled

POSITION_TOLERANCE_M = 1e-4
STOP_WITHIN_S = 1.0


def down(state, way_m):
    """The pose `way_m` below where the flange is."""
    target = state.pose.base_from_tool0.copy()
    target[2, 3] -= way_m
    return target


def linear(target, speed_mps=0.25, acceleration_mps2=0.5):
    return LinearMove(
        base_from_tool0=target, speed_mps=speed_mps, acceleration_mps2=acceleration_mps2
    )


def joint(target, speed_rps=1.0, acceleration_rps2=2.0):
    return JointMove(
        joints_rad=np.asarray(target), speed_rps=speed_rps, acceleration_rps2=acceleration_rps2
    )


def height(arm):
    return arm.state().pose.base_from_tool0[2, 3]


def assert_stands_still(arm, for_s=0.2):
    joints = arm.state().joints_rad
    until = time.perf_counter() + for_s
    while time.perf_counter() < until:
        assert np.array_equal(arm.state().joints_rad, joints)


def wait_until_at_rest(arm, within_s=STOP_WITHIN_S):
    until = time.perf_counter() + within_s
    still = 0
    while still < 5:
        assert time.perf_counter() < until, "the arm still moves"
        still = still + 1 if np.abs(arm.state().joint_speeds_rps).max() < 1e-3 else 0
        time.sleep(0.01)


class ArmContract:
    @pytest.fixture
    def arm(self, make_arm):
        with make_arm() as arm:
            yield arm

    def test_outside_its_block_it_says_so(self, make_arm):
        arm = make_arm()
        for asked in (arm.state, arm.check):
            with pytest.raises(NotConnectedError):
                asked()
        with arm:
            arm.state()
            arm.check()
        arm.__exit__(None, None, None)
        with pytest.raises(NotConnectedError):
            arm.start_move(joint([0.0] * 6))

    def test_it_can_be_entered_again(self, make_arm):
        arm = make_arm()
        for _ in range(2):
            with arm:
                assert arm.state().mode is ArmMode.READY

    def test_entering_moves_nothing(self, arm):
        assert arm.state().mode is ArmMode.READY
        assert_stands_still(arm)

    def test_stamps_increase_strictly_and_are_never_old(self, arm):
        stamps = []
        while len(stamps) < 20:
            state = arm.state()
            age_ns = time.monotonic_ns() - state.pose.stamp_ns
            assert -5e6 < age_ns < 2e8
            if stamps[-1:] != [state.pose.stamp_ns]:
                stamps.append(state.pose.stamp_ns)
        assert (np.diff(stamps) > 0).all()

    def test_a_linear_move_arrives_and_settles(self, arm):
        target = down(arm.state(), 0.1)
        arm.start_move(linear(target))
        assert arm.state().mode is ArmMode.MOVING
        end = wait_settled(arm, timeout_s=10.0)
        assert end.mode is ArmMode.READY
        assert end.pose.base_from_tool0 == pytest.approx(target, abs=POSITION_TOLERANCE_M)
        assert end.tool_speed_mps < 1e-3

    def test_a_joint_move_arrives_and_settles(self, arm):
        target = np.add(arm.state().joints_rad, [0.2, -0.1, 0.15, 0.1, -0.2, 0.4])
        arm.start_move(joint(target))
        end = wait_settled(arm, timeout_s=10.0)
        assert end.joints_rad == pytest.approx(target, abs=1e-4)

    def test_a_move_to_where_it_stands_ends_at_once(self, arm):
        arm.start_move(linear(arm.state().pose.base_from_tool0))
        wait_settled(arm, timeout_s=2.0)

    def test_a_second_move_is_refused_and_the_first_goes_on(self, arm):
        start = arm.state()
        arm.start_move(linear(down(start, 0.2), speed_mps=0.05))
        with pytest.raises(ArmBusyError):
            arm.start_move(linear(down(start, 0.0)))
        end = wait_settled(arm, timeout_s=20.0)
        assert end.pose.base_from_tool0[2, 3] == pytest.approx(
            start.pose.base_from_tool0[2, 3] - 0.2, abs=POSITION_TOLERANCE_M
        )

    @pytest.mark.parametrize("way", ["stop", "drop"])
    def test_stop_ends_a_move_for_good(self, arm, way):
        start = arm.state()
        arm.start_move(linear(down(start, 0.25), speed_mps=0.02))
        time.sleep(0.1)
        getattr(arm, way)()
        assert arm.state().mode is ArmMode.INTERRUPTED
        with pytest.raises(MoveInterruptedError):
            wait_settled(arm, timeout_s=1.0)
        wait_until_at_rest(arm)
        assert start.pose.base_from_tool0[2, 3] - height(arm) < 0.24
        assert_stands_still(arm)

    def test_after_a_stop_a_new_move_needs_no_acknowledgement(self, arm):
        target = down(arm.state(), 0.25)
        arm.start_move(linear(target, speed_mps=0.02))
        arm.stop()
        arm.start_move(linear(target))
        end = wait_settled(arm, timeout_s=10.0)
        assert end.pose.base_from_tool0 == pytest.approx(target, abs=POSITION_TOLERANCE_M)

    def test_stopping_a_still_arm_is_harmless(self, arm):
        for _ in range(2):
            arm.stop()
        assert arm.state().mode is ArmMode.READY
        arm.start_move(linear(down(arm.state(), 0.05)))
        wait_settled(arm, timeout_s=5.0)

    def test_stop_reaches_a_waiting_thread(self, arm):
        arm.start_move(linear(down(arm.state(), 0.25), speed_mps=0.01))
        threading.Timer(0.2, arm.stop).start()
        started = time.perf_counter()
        with pytest.raises(MoveInterruptedError):
            wait_settled(arm, timeout_s=20.0)
        assert time.perf_counter() - started < 0.2 + STOP_WITHIN_S

    def test_leaving_stops_a_move(self, make_arm):
        with make_arm() as arm:
            target = down(arm.state(), 0.25)
            arm.start_move(linear(target, speed_mps=0.01))
        with arm:
            wait_until_at_rest(arm)
            assert height(arm) > target[2, 3] + 0.01

    def test_waiting_gives_up_but_does_not_stop(self, arm):
        arm.start_move(linear(down(arm.state(), 0.25), speed_mps=0.02))
        with pytest.raises(SettleTimeoutError):
            wait_settled(arm, timeout_s=0.1)
        assert arm.state().mode is ArmMode.MOVING

    @pytest.mark.parametrize(
        ("sideways_m", "error"), [(3.0, UnreachableError), (float("nan"), MoveRefusedError)]
    )
    def test_a_target_out_of_reach_is_refused_and_nothing_moves(self, arm, sideways_m, error):
        target = down(arm.state(), 0.0)
        target[0, 3] += sideways_m
        with pytest.raises(error):
            arm.start_move(linear(target))
        assert arm.state().mode is ArmMode.READY
        assert_stands_still(arm)

    def test_joints_over_their_limit_are_refused_and_nothing_moves(self, arm):
        joints = arm.state().joints_rad.copy()
        joints[5] = 6.4
        with pytest.raises(JointLimitError):
            arm.start_move(joint(joints))
        assert_stands_still(arm)

    @pytest.mark.parametrize("speed_mps", [0.0, -0.1, float("nan"), float("inf")])
    def test_a_speed_that_is_none_is_refused(self, arm, speed_mps):
        with pytest.raises(MoveRefusedError, match="speed"):
            arm.start_move(linear(down(arm.state(), 0.05), speed_mps=speed_mps))

    def test_acknowledging_nothing_is_harmless(self, arm):
        arm.start_move(linear(down(arm.state(), 0.2), speed_mps=0.05))
        arm.acknowledge("nothing was wrong")
        assert arm.state().mode is ArmMode.MOVING
        wait_settled(arm, timeout_s=10.0)
