import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers import kinematics
from mock_hw.fake_ur.motion import JointWay, LineWay, Motion, PathError

speeds = st.floats(0.05, 3.0)
accelerations = st.floats(0.05, 10.0)
lengths = st.floats(0.001, 6.0)
TICK_S = 0.008


def joint_way(length):
    end = np.zeros(6)
    end[2] = length
    return JointWay(np.zeros(6), end)


def run(motion, tick_s=TICK_S, limit=200_000):
    rates, travelled = [motion.rate], [motion.travelled]
    while not motion.done:
        motion.advance(tick_s)
        rates.append(motion.rate)
        travelled.append(motion.travelled)
        assert len(rates) < limit
    return np.array(rates), np.array(travelled)


@settings(max_examples=40)
@given(length=lengths, speed=speeds, acceleration=accelerations)
def test_a_run_is_a_trapezoid(length, speed, acceleration):
    rates, travelled = run(Motion(joint_way(length), speed, acceleration))

    assert travelled[-1] == length
    assert (np.diff(travelled) >= 0).all()
    assert rates.max() <= speed + 1e-12
    changes = np.diff(rates[:-1]) / TICK_S
    assert changes.max(initial=0.0) <= acceleration * (1 + 1e-9)
    assert changes.min(initial=0.0) >= -acceleration * (1 + 1e-6) - 1e-6
    reached = min(speed, math.sqrt(acceleration * length))
    duration_s = length / reached + reached / acceleration
    assert abs((len(rates) - 1) * TICK_S - duration_s) <= 3 * TICK_S


@given(length=lengths, speed=speeds, acceleration=accelerations, scale=st.integers(1, 40))
def test_a_coarse_clock_takes_the_same_run(length, speed, acceleration, scale):
    fine, coarse = (Motion(joint_way(length), speed, acceleration) for _ in range(2))
    for _ in range(scale):
        fine.advance(TICK_S)
    coarse.advance(TICK_S * scale)

    assert coarse.travelled == pytest.approx(fine.travelled, abs=1e-12)


@given(speed=speeds, acceleration=accelerations, deceleration=st.floats(0.1, 10.0))
def test_braking_takes_no_more_way_than_physics(speed, acceleration, deceleration):
    motion = Motion(joint_way(6.0), speed, acceleration)
    motion.advance(0.5)
    rate, start = motion.rate, motion.travelled

    motion.brake(deceleration)
    rates, travelled = run(motion)

    assert rates[-1] == 0.0
    way = rate**2 / (2 * deceleration)
    assert min(start + way, 6.0) - 1e-6 <= travelled[-1] <= start + way + rate * TICK_S


def test_a_held_motion_goes_on_when_released_but_a_braked_one_does_not():
    held, braked = (Motion(joint_way(1.0), 0.5, 1.0) for _ in range(2))
    for motion in (held, braked):
        motion.advance(0.8)
    held.holding = 5.0
    braked.brake(5.0)
    for motion in (held, braked):
        motion.advance(2.0)
    rest = braked.travelled
    held.holding = None
    run(held)
    braked.advance(2.0)

    assert held.travelled == 1.0
    assert braked.done
    assert braked.travelled == rest


def test_a_line_is_straight_for_the_tool_centre_point():
    start_joints = np.array([0.2, -1.4, 1.6, -1.5, -1.4, 0.3])
    tool0_from_tcp = kinematics.transform_from_pose([0.02, 0.0, 0.12, 0.3, 0.0, 0.0])
    start = kinematics.forward(start_joints) @ tool0_from_tcp
    end = kinematics.transform_from_pose(np.add(kinematics.pose_from_transform(start), 0.1))
    way = LineWay(start, end, tool0_from_tcp)

    joints = start_joints
    for travelled in np.linspace(0, way.length, 40):
        joints = way.joints_at(travelled, joints)
        tcp = (kinematics.forward(joints) @ tool0_from_tcp)[:3, 3]
        wanted = start[:3, 3] + travelled / way.length * (end - start)[:3, 3]
        assert tcp == pytest.approx(wanted, abs=1e-9)


def test_a_line_out_of_reach_ends_where_the_reach_ends():
    start_joints = np.array([0.2, -1.4, 1.6, -1.5, -1.4, 0.3])
    start = kinematics.forward(start_joints)
    end = start.copy()
    end[0, 3] -= 2.0
    way = LineWay(start, end, np.eye(4))

    assert way.joints_at(0.05, start_joints) is not None
    with pytest.raises(PathError, match="no solution"):
        way.joints_at(1.5, start_joints)
