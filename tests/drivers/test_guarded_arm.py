import numpy as np
import pytest
from contracts.arm import ArmContract, assert_stands_still, down, joint, linear

from drivers import kinematics
from drivers.errors import SpeedCapError, UnreachableError, WorkspaceError
from drivers.guarded_arm import GuardedArm, KeepOut, Limits, check
from drivers.protocols import ArmMode, ArmState, ToolPose
from drivers.ur5.arm import Ur5Arm
from drivers.ur5.messages import Ur5Config

HOME = np.array([0.0, -np.pi / 2, np.pi / 2, -np.pi / 2, -np.pi / 2, 0.0])
WIDE = {"box_min_m": (-1.5, -1.5, -1.5), "box_max_m": (1.5, 1.5, 2.0)}
TRUNK = KeepOut(name="trunk", normal=(1.0, 0.0, 0.0), offset_m=-0.7)


def standing(joints=HOME):
    return ArmState(
        pose=ToolPose(stamp_ns=0, base_from_tool0=kinematics.forward(joints)),
        joints_rad=joints,
        joint_speeds_rps=np.zeros(6),
        tool_speed_mps=0.0,
        mode=ArmMode.READY,
    )


def shifted(state, **shift_m):
    target = state.pose.base_from_tool0.copy()
    for axis, value in shift_m.items():
        target["xyz".index(axis), 3] += value
    return target


class TestGuardedUr5Arm(ArmContract):
    """Within wide limits a guarded arm is an arm."""

    @pytest.fixture
    def make_arm(self, fake):
        limits = Limits(**WIDE, joint_speed_rps=1.5, joint_acceleration_rps2=5.0, speed_mps=2.0)
        return lambda: GuardedArm(Ur5Arm(Ur5Config(host=fake.host)), limits)


def test_a_move_out_of_the_box_is_refused_and_nothing_moves(fake):
    arm = Ur5Arm(Ur5Config(host=fake.host))
    limits = Limits(box_min_m=(-1.0, -0.5, 0.3), box_max_m=(0.0, 0.5, 1.0))
    with GuardedArm(arm, limits) as guarded:
        with pytest.raises(WorkspaceError, match="outside the workspace box"):
            guarded.start_move(linear(down(guarded.state(), 0.2)))
        assert_stands_still(guarded)


def test_moves_within_limits_pass():
    state = standing()
    check(linear(shifted(state, z=-0.1, y=0.1)), state, Limits(**WIDE, keep_outs=(TRUNK,)))
    check(joint(HOME + 0.1, speed_rps=0.2, acceleration_rps2=1.0), state, Limits(**WIDE))


@pytest.mark.parametrize(
    ("move", "word"),
    [
        (linear(shifted(standing(), z=-0.1), speed_mps=0.3), "speed"),
        (linear(shifted(standing(), z=-0.1), acceleration_mps2=0.6), "acceleration"),
        (joint(HOME + 0.1, speed_rps=1.1), "joint speed"),
        (joint(HOME + 0.1, speed_rps=0.1, acceleration_rps2=1.6), "joint acceleration"),
    ],
)
def test_caps(move, word):
    with pytest.raises(SpeedCapError, match=rf"^{word} .* is over the cap"):
        check(move, standing(), Limits(**WIDE))


def test_a_joint_move_that_swings_the_tool_too_fast_is_refused():
    turned = np.add(HOME, [0.5, 0, 0, 0, 0, 0])
    check(joint(turned, speed_rps=0.45, acceleration_rps2=1.0), standing(), Limits(**WIDE))
    with pytest.raises(SpeedCapError, match="the tool's speed on this joint move"):
        check(joint(turned, speed_rps=0.6, acceleration_rps2=1.0), standing(), Limits(**WIDE))


def test_a_line_that_whirls_a_joint_is_refused():
    state = standing(np.array([0.0, -1.5, 1.6, -1.6, -1.5, 0.0]))
    past_the_column = state.pose.base_from_tool0.copy()
    past_the_column[:3, 3] = (0.05, -0.16, 0.45)
    with pytest.raises(SpeedCapError, match="a joint's speed on this line"):
        check(linear(past_the_column), state, Limits(**WIDE))


def tilted(state, vector_rad):
    target = state.pose.base_from_tool0.copy()
    target[:3, :3] = target[:3, :3] @ kinematics.rotation_from_vector(np.array(vector_rad))
    return target


def test_a_turn_in_place_that_whirls_a_joint_is_refused():
    """Near a straight wrist two joints turn much faster than the tool."""
    state = standing(np.array([0.0, -1.5, 1.6, -1.6, 0.3, 0.0]))
    move = linear(tilted(state, (0.5, 0.0, 0.0)), speed_mps=0.25)
    check(move, state, Limits(**WIDE, joint_speed_rps=1.2))
    with pytest.raises(SpeedCapError, match="a joint's speed on this line"):
        check(move, state, Limits(**WIDE, joint_speed_rps=0.9))


def test_a_turn_in_place_is_as_fast_as_its_number_says():
    """Joint 6 turns alone."""
    state = standing()
    move = linear(tilted(state, (0.0, 0.0, 0.5)), speed_mps=0.2)
    check(move, state, Limits(**WIDE, joint_speed_rps=0.201))
    with pytest.raises(SpeedCapError, match=r"line, 0\.2 rad/s"):
        check(move, state, Limits(**WIDE, joint_speed_rps=0.199))


def test_the_box_holds_for_the_tool_all_along_a_joint_move():
    half_turn = np.add(HOME, [np.pi, 0, 0, 0, 0, 0])
    side = Limits(box_min_m=(-1.0, -0.4, -1.0), box_max_m=(1.0, 0.4, 1.0), joint_speed_rps=1.0)
    move = joint(half_turn, speed_rps=0.2, acceleration_rps2=1.0)
    ends = kinematics.forward(half_turn)[:3, 3]
    assert np.all(np.abs(ends) <= [1.0, 0.4, 1.0])
    with pytest.raises(WorkspaceError, match="outside the workspace box"):
        check(move, standing(), side)


def test_a_keep_out_plane_stops_the_tool_before_the_flange():
    state = standing()
    move = linear(shifted(state, z=-0.1))
    ground = KeepOut(name="ground", normal=(0.0, 0.0, 1.0), offset_m=0.1)
    slim = {"keep_outs": (ground,), "body_radius_m": 0.05}
    check(move, state, Limits(**WIDE, **slim))
    camera = np.array([[0.0, 0.0, 0.25]])
    with pytest.raises(WorkspaceError, match="too close to keep-out 'ground'"):
        check(move, state, Limits(**WIDE, **slim, tool_points_in_tool0=camera))


def test_a_keep_out_plane_stops_the_elbow_too():
    state = standing()
    behind = KeepOut(name="cabinet", normal=(-1.0, 0.0, 0.0), offset_m=-0.2)
    check(linear(shifted(state, z=-0.1)), state, Limits(**WIDE, keep_outs=(behind,)))
    lean_back = np.add(HOME, [0.0, -0.9, 0.9, 0.0, 0.0, 0.0])
    assert kinematics.forward(lean_back)[0, 3] < 0.05
    with pytest.raises(WorkspaceError, match="cabinet"):
        check(
            joint(lean_back, speed_rps=0.1, acceleration_rps2=1.0),
            state,
            Limits(**WIDE, keep_outs=(behind,)),
        )


def test_a_line_nobody_can_follow_is_unreachable():
    state = standing()
    with pytest.raises(UnreachableError):
        check(linear(shifted(state, x=-1.0)), state, Limits(**WIDE))
