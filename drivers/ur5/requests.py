"""A move as the controller takes it, after checking that the arm can follow it."""

import math

import numpy as np

from canopy_skel.geometry import is_rigid
from drivers import kinematics
from drivers.errors import JointLimitError, MoveRefusedError, UnreachableError
from drivers.protocols import ArmState, JointMove, LinearMove, Move
from drivers.ur5.messages import MoveJoints, MoveLinear


def request_for(move: Move, state: ArmState) -> MoveLinear | MoveJoints:
    """Return the request for a move that begins where the arm stands.

    Raises:
        UnreachableError: no joints for the target, or not along the line to it.
        JointLimitError: a joint would leave ±360°.
        MoveRefusedError: the numbers make no move.
    """
    if isinstance(move, LinearMove):
        return _linear(move, state)
    return _joints(move)


def _linear(move: LinearMove, state: ArmState) -> MoveLinear:
    _check_rates(move.speed_mps, move.acceleration_mps2)
    target = move.base_from_tool0
    if not is_rigid(target):
        raise MoveRefusedError("base_from_tool0 is not a rigid transform: check the plan")
    x, y, z = target[:3, 3]
    if kinematics.inverse(target, state.joints_rad) is None:
        raise UnreachableError(f"no joints bring the tool to ({x:.3f}, {y:.3f}, {z:.3f}) m")
    path = kinematics.straight_joints(state.pose.base_from_tool0, target, state.joints_rad)
    if path is None:
        raise UnreachableError(
            f"the straight line to ({x:.3f}, {y:.3f}, {z:.3f}) m leaves the reach of the arm or"
            " passes a singularity: go there by a joint move or over another waypoint"
        )
    if not kinematics.within_limits(path.ravel()):
        raise JointLimitError(
            f"a joint would leave ±360° on the way to ({x:.3f}, {y:.3f}, {z:.3f}) m:"
            " unwind it by a joint move first"
        )
    return MoveLinear(
        kinematics.pose_from_transform(target), move.speed_mps, move.acceleration_mps2
    )


def _joints(move: JointMove) -> MoveJoints:
    _check_rates(move.speed_rps, move.acceleration_rps2)
    joints = np.asarray(move.joints_rad, dtype=np.float64)
    if joints.shape != (6,) or not kinematics.within_limits(joints):
        raise JointLimitError(
            f"joints {np.round(joints, 3).tolist()} are not six angles within ±360°"
        )
    return MoveJoints(tuple(joints.tolist()), move.speed_rps, move.acceleration_rps2)


def _check_rates(speed: float, acceleration: float) -> None:
    for name, value in (("speed", speed), ("acceleration", acceleration)):
        if not (math.isfinite(value) and value > 0):
            raise MoveRefusedError(f"{name} is {value}; it must be above 0")
