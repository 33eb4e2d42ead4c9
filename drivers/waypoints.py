"""From where the arm is to the next waypoint: a move that is allowed all the way, or the reason."""

import math
from dataclasses import replace
from itertools import product

import numpy as np

from canopy_skel.geometry import FloatArray
from drivers import kinematics
from drivers.errors import MoveRefusedError, UnreachableError
from drivers.guarded_arm import Limits, check, check_posture, tool_lead
from drivers.protocols import ArmMode, ArmState, JointMove, LinearMove, Move, ToolPose

JOINT_SPEEDS_RPS = (0.8, 0.4, 0.2, 0.1)
"""Of the leading joint, where the flange may go at USUAL_SPEED_MPS and speed up with
USUAL_ACCELERATION_MPS2; in proportion where less was asked for."""
USUAL_SPEED_MPS, USUAL_ACCELERATION_MPS2 = 0.25, 0.5


READY_JOINTS_RAD = np.array([np.pi, -np.pi / 2, np.pi / 2, -np.pi / 2, -np.pi / 2, 0.0])
"""Upright, elbow bent, facing the tree: from here every part of the workspace is near."""


def moves_to(
    state: ArmState,
    base_from_tool0: FloatArray,
    limits: Limits,
    *,
    speed_mps: float,
    acceleration_mps2: float,
) -> tuple[Move, ...]:
    """Return the moves from `state` to a pose: one if possible, else two by way of readiness.

    None moves flange or tool faster than asked, or has a joint turn faster than the limits allow.

    Raises:
        MoveRefusedError: there is no allowed way; the reason is that of the direct one.
    """
    speeds = {"speed_mps": speed_mps, "acceleration_mps2": acceleration_mps2}
    try:
        return (move_to(state, base_from_tool0, limits, **speeds),)
    except MoveRefusedError as refusal:
        ready = _turn(state, [READY_JOINTS_RAD], limits, **speeds)
        if ready is None:
            raise
        try:
            return ready, move_to(after(state, ready), base_from_tool0, limits, **speeds)
        except MoveRefusedError:
            raise refusal from None


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
        MoveRefusedError: neither is allowed; the reason is that of the straight one if the arm can
            be at the pose at all.
    """
    speeds = {"speed_mps": speed_mps, "acceleration_mps2": acceleration_mps2}
    try:
        lead = tool_lead(base_from_tool0, state, limits)
        slower = 1.0 if lead == 1.0 else 0.999 / lead  # a hair under the cap, not beside it
        straight = LinearMove(
            base_from_tool0=base_from_tool0,
            speed_mps=slower * speed_mps,
            acceleration_mps2=slower * acceleration_mps2,
        )
        check(straight, state, limits)
    except MoveRefusedError as refusal:
        return _turn_to(state, base_from_tool0, limits, speeds, refusal)
    return straight


def _turn_to(
    state: ArmState,
    base_from_tool0: FloatArray,
    limits: Limits,
    speeds: dict[str, float],
    refusal: MoveRefusedError,
) -> Move:
    solutions = kinematics.inverses(base_from_tool0, state.joints_rad)
    if not solutions:
        raise UnreachableError(str(refusal))
    move = _turn(state, solutions, limits, **speeds)
    if move is None:
        raise _why_not_there(solutions, limits) or refusal
    return move


def _why_not_there(postures: list[FloatArray], limits: Limits) -> MoveRefusedError | None:
    """Return why the arm must not be in the first of the postures, None if one is allowed."""
    reasons = []
    for joints in postures:
        try:
            check_posture(joints, limits)
        except MoveRefusedError as error:
            reasons.append(error)
        else:
            return None
    return reasons[0]


def _turn(
    state: ArmState,
    postures: list[FloatArray],
    limits: Limits,
    *,
    speed_mps: float,
    acceleration_mps2: float,
) -> JointMove | None:
    """Return an allowed move to one of the postures: near ones first, slower ones last."""
    slower = min(1.0, speed_mps / USUAL_SPEED_MPS)
    gentler = min(1.0, acceleration_mps2 / USUAL_ACCELERATION_MPS2)
    asked = replace(limits, speed_mps=min(limits.speed_mps, speed_mps))
    for usual_rps, joints in product(JOINT_SPEEDS_RPS, postures):
        usual_rps2 = min(1.0, 2 * slower * usual_rps)
        move = JointMove(
            joints_rad=joints,
            speed_rps=min(slower * usual_rps, limits.joint_speed_rps),
            acceleration_rps2=min(gentler * usual_rps2, limits.joint_acceleration_rps2),
        )
        try:
            check(move, state, asked)
        except MoveRefusedError:
            continue
        return move
    return None


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


def travel_s(state: ArmState, move: Move) -> float:
    """Return how many seconds a move from `state` takes at most, if nothing slows it down.

    Speeds of a line are of metres and, as controllers turn the tool with the same number, of
    radians too; which of both leads is theirs to say, so here one comes after the other.
    """
    if isinstance(move, JointMove):
        turn_rad = float(np.abs(move.joints_rad - state.joints_rad).max())
        return _ramped_s(turn_rad, move.speed_rps, move.acceleration_rps2)
    start, end = state.pose.base_from_tool0, move.base_from_tool0
    turn = kinematics.rotation_vector(kinematics.relative_turn(start, end))
    way = float(np.linalg.norm(end[:3, 3] - start[:3, 3]) + np.linalg.norm(turn))
    return _ramped_s(way, move.speed_mps, move.acceleration_mps2)


def _ramped_s(way: float, speed: float, acceleration: float) -> float:
    """Return the duration of speeding up, cruising and slowing down; short ways have no cruise."""
    if way * acceleration < speed**2:
        return 2 * math.sqrt(way / acceleration)
    return way / speed + speed / acceleration
