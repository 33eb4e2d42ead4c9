"""From where the arm is to the next waypoint: a move that is allowed all the way, or the reason."""

from dataclasses import replace

import numpy as np

from canopy_skel.geometry import FloatArray
from drivers import kinematics
from drivers.errors import MoveRefusedError, UnreachableError
from drivers.guarded_arm import Limits, check
from drivers.protocols import ArmMode, ArmState, JointMove, LinearMove, Move, ToolPose

JOINT_SPEEDS_RPS = (0.8, 0.4, 0.2, 0.1)


def move_to(
    state: ArmState,
    base_from_tool0: FloatArray,
    limits: Limits,
    *,
    speed_mps: float,
    acceleration_mps2: float,
) -> Move:
    """Return the move from `state` to a pose: straight if possible, else through the joints.

    Raises:
        MoveRefusedError: neither is allowed; the reason is that of the straight one if the pose
            can be reached at all.
    """
    straight = LinearMove(
        base_from_tool0=base_from_tool0, speed_mps=speed_mps, acceleration_mps2=acceleration_mps2
    )
    try:
        check(straight, state, limits)
    except MoveRefusedError as refusal:
        return _turn_to(state, base_from_tool0, limits, refusal)
    return straight


def _turn_to(
    state: ArmState, base_from_tool0: FloatArray, limits: Limits, refusal: MoveRefusedError
) -> Move:
    joints = kinematics.inverse(base_from_tool0, state.joints_rad)
    if joints is None:
        raise UnreachableError(str(refusal))
    for speed_rps in JOINT_SPEEDS_RPS:
        move = JointMove(
            joints_rad=joints, speed_rps=speed_rps, acceleration_rps2=min(1.0, 2 * speed_rps)
        )
        try:
            check(move, state, limits)
        except MoveRefusedError:
            continue
        return move
    raise refusal


def after(state: ArmState, move: Move) -> ArmState:
    """Return the state in which the arm will be when a move has ended."""
    if isinstance(move, JointMove):
        joints = move.joints_rad
        pose = kinematics.forward(joints)
    else:
        pose = move.base_from_tool0
        joints = kinematics.straight_joints(state.pose.base_from_tool0, pose, state.joints_rad)[-1]
    return replace(
        state,
        pose=ToolPose(stamp_ns=state.pose.stamp_ns, base_from_tool0=pose),
        joints_rad=joints,
        joint_speeds_rps=np.zeros(6),
        tool_speed_mps=0.0,
        mode=ArmMode.READY,
    )
