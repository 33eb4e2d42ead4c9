from dataclasses import replace

import numpy as np
import pytest
from contracts.arm import down, joint, linear

from canopy_skel.geometry import invert
from drivers import kinematics
from drivers.errors import MoveRefusedError
from drivers.guarded_arm import Limits
from drivers.protocols import ArmMode, ArmState, JointMove, LinearMove, ToolPose
from drivers.waypoints import READY_JOINTS_RAD, after, moves_to, travel_s
from mock_hw.fake_ur.motion import JointWay, LineWay, Motion
from mock_hw.orchard.path import TOOL_FROM_CAMERA, camera_path

STANDING = ArmState(
    pose=ToolPose(stamp_ns=0, base_from_tool0=kinematics.forward(READY_JOINTS_RAD)),
    joints_rad=READY_JOINTS_RAD,
    joint_speeds_rps=np.zeros(6),
    tool_speed_mps=0.0,
    mode=ArmMode.READY,
)


def turned(angle_rad):
    pose = down(STANDING, 0.0)
    pose[:3, :3] = pose[:3, :3] @ kinematics.rotation_from_vector(np.array([0, 0, angle_rad]))
    return pose


@pytest.mark.parametrize(
    ("target", "speed_mps", "acceleration_mps2"),
    [(down(STANDING, way_m), v, a) for way_m in (0, 0.01, 0.3) for v, a in [(0.25, 0.5), (0.02, 9)]]
    + [(turned(angle_rad), 0.1, 0.1) for angle_rad in (0.05, 1.0, 3.0)],
)
def test_a_line_is_given_as_long_as_it_takes(target, speed_mps, acceleration_mps2):
    way = LineWay(STANDING.pose.base_from_tool0, target, np.eye(4))
    took_s = duration_s(Motion(way=way, speed=speed_mps, acceleration=acceleration_mps2))
    allowed_s = travel_s(STANDING, linear(target, speed_mps, acceleration_mps2))
    assert allowed_s == pytest.approx(took_s, abs=0.02)


@pytest.mark.parametrize(("speed_rps", "acceleration_rps2"), [(0.8, 1.0), (0.1, 0.2)])
@pytest.mark.parametrize("turn_rad", [0.01, 3.0])
def test_a_joint_move_is_given_as_long_as_its_leading_joint_takes(
    turn_rad, speed_rps, acceleration_rps2
):
    target = READY_JOINTS_RAD + np.array([0.1, -1.0, 0.5, 0.0, 0.0, 0.2]) * turn_rad
    way = JointWay(READY_JOINTS_RAD, target)
    took_s = duration_s(Motion(way=way, speed=speed_rps, acceleration=acceleration_rps2))
    allowed_s = travel_s(STANDING, joint(target, speed_rps, acceleration_rps2))
    assert allowed_s == pytest.approx(took_s, abs=0.02)


def test_a_line_that_turns_is_given_time_for_both():
    target = turned(1.0)
    target[2, 3] -= 0.5
    assert travel_s(STANDING, linear(target, 0.1, 1.0)) == pytest.approx(1.5 / 0.1 + 0.1)


def duration_s(motion):
    steps = 0
    while not motion.done:
        motion.advance(0.008)
        steps += 1
    return 0.008 * steps


@pytest.mark.parametrize("speed_mps", [0.25, 0.1, 0.02, 0.005])
def test_a_move_through_the_joints_is_no_faster_than_asked(speed_mps):
    limits = Limits(box_min_m=(-0.9, -0.9, -0.85), box_max_m=(0.9, 0.9, 1.1))
    state, through_the_joints = STANDING, 0
    for base_from_camera in camera_path(70)[::9]:
        pose = base_from_camera @ invert(TOOL_FROM_CAMERA)
        for move in moves_to(state, pose, limits, speed_mps=speed_mps, acceleration_mps2=0.5):
            if isinstance(move, JointMove):
                through_the_joints += 1
                assert fastest_mps(state, move) <= 1.001 * speed_mps
            state = after(state, move)
    assert through_the_joints


TOOL = np.array([[-0.10, 0.0, 0.09], [0.05, 0.07, 0.09], [0.05, -0.07, 0.09]])


@pytest.mark.parametrize(
    ("way_m", "angle_rad", "speed_mps"),
    [(0.13, 0.52, 0.25), (0.13, 0.52, 0.05), (0.03, 0.52, 0.05), (0.3, 0.0, 0.25)],
)
def test_a_tool_that_turns_on_a_line_is_no_faster_than_asked(way_m, angle_rad, speed_mps):
    limits = Limits(
        box_min_m=(-0.9, -0.9, -0.85), box_max_m=(0.9, 0.9, 1.1), tool_points_in_tool0=TOOL
    )
    goal = turned(angle_rad)
    goal[2, 3] -= way_m
    [move] = moves_to(STANDING, goal, limits, speed_mps=speed_mps, acceleration_mps2=0.5)
    poses = [
        kinematics.interpolate(STANDING.pose.base_from_tool0, goal, fraction)
        for fraction in np.linspace(0, 1, 100)
    ]
    places = np.array([pose[:3, :3] @ TOOL.T + pose[:3, 3:] for pose in poses])
    step_s = way_m / 99 / move.speed_mps
    fastest = np.linalg.norm(np.diff(places, axis=0), axis=1).max() / step_s
    assert fastest <= 1.001 * speed_mps
    assert fastest >= 0.9 * speed_mps


def test_a_tool_that_only_turns_is_let_turn():
    limits = Limits(
        box_min_m=(-0.9, -0.9, -0.85), box_max_m=(0.9, 0.9, 1.1), tool_points_in_tool0=TOOL
    )
    [move] = moves_to(STANDING, turned(0.5), limits, speed_mps=0.2, acceleration_mps2=0.5)
    assert move.speed_mps == 0.2


def test_a_tool_that_turns_in_place_near_a_straight_wrist_whirls_no_joint():
    limits = Limits(
        box_min_m=(-1.5, -1.5, -1.5), box_max_m=(1.5, 1.5, 2.0), tool_points_in_tool0=TOOL
    )
    rng, lines = np.random.default_rng(0), 0
    for _ in range(200):
        joints = READY_JOINTS_RAD + rng.normal(0, 0.3, 6)
        joints[4] = rng.choice([-1, 1]) * rng.uniform(0.1, 0.5)
        start = kinematics.forward(joints)
        state = replace(
            STANDING, joints_rad=joints, pose=ToolPose(stamp_ns=0, base_from_tool0=start)
        )
        turn = rng.normal(size=3)
        turn *= rng.uniform(0.3, 1.0) / np.linalg.norm(turn)
        goal = start.copy()
        goal[:3, :3] = start[:3, :3] @ kinematics.rotation_from_vector(turn)
        try:
            moves = moves_to(state, goal, limits, speed_mps=0.25, acceleration_mps2=0.5)
        except MoveRefusedError:
            continue
        if isinstance(moves[0], LinearMove):
            lines += 1
            assert fastest_rps(state, moves[0]) <= 1.01 * limits.joint_speed_rps
    assert lines > 10


def fastest_rps(state, move):
    """How fast a joint gets on a line, as the controller drives it."""
    way = LineWay(state.pose.base_from_tool0, move.base_from_tool0, np.eye(4))
    motion = Motion(way=way, speed=move.speed_mps, acceleration=move.acceleration_mps2)
    joints, fastest = state.joints_rad, 0.0
    while not motion.done:
        motion.advance(0.008)
        before, joints = joints, way.joints_at(motion.travelled, joints)
        fastest = max(fastest, np.abs(joints - before).max() / 0.008)
    return fastest


@pytest.mark.parametrize(
    ("caps", "asked_mps2"),
    [({"joint_speed_rps": 0.05}, 0.5), ({"joint_acceleration_rps2": 0.1}, 0.5), ({}, 0.01)],
)
def test_joint_moves_keep_to_caps_and_to_the_acceleration_asked_for(caps, asked_mps2):
    limits = Limits(box_min_m=(-0.9, -0.9, -0.85), box_max_m=(0.9, 0.9, 1.1), **caps)
    state, through_the_joints = STANDING, 0
    for base_from_camera in camera_path(70)[::9]:
        pose = base_from_camera @ invert(TOOL_FROM_CAMERA)
        for move in moves_to(state, pose, limits, speed_mps=0.1, acceleration_mps2=asked_mps2):
            if isinstance(move, JointMove):
                through_the_joints += 1
                assert move.speed_rps <= limits.joint_speed_rps
                assert move.acceleration_rps2 <= limits.joint_acceleration_rps2
                assert move.acceleration_rps2 <= 2 * asked_mps2  # of a flange within a metre
            state = after(state, move)
    assert through_the_joints


def fastest_mps(state, move):
    """How fast the flange gets while the leading joint turns at full speed."""
    way = kinematics.turned_joints(state.joints_rad, move.joints_rad, 0.01)
    places = np.array([kinematics.forward(joints)[:3, 3] for joints in way])
    turn_rad = np.abs(np.diff(way, axis=0)).max(axis=1)
    return (np.linalg.norm(np.diff(places, axis=0), axis=1) / turn_rad).max() * move.speed_rps
