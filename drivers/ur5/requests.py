"""A move as the controller takes it, after checking that the arm can follow it."""

import numpy as np

from drivers import kinematics
from drivers.errors import JointLimitError
from drivers.protocols import ArmState, LinearMove, Move
from drivers.ur5.messages import MoveJoints, MoveLinear


def request_for(move: Move, state: ArmState) -> MoveLinear | MoveJoints:
    """Return the request for a move that begins where the arm stands.

    Raises:
        UnreachableError: no joints for the target, or not along the line to it.
        JointLimitError: a joint target is outside ±360°.
    """
    if isinstance(move, LinearMove):
        target = move.base_from_tool0
        kinematics.straight_joints(state.pose.base_from_tool0, target, state.joints_rad)
        pose = kinematics.pose_from_transform(target)
        return MoveLinear(pose, move.speed_mps, move.acceleration_mps2)
    if not kinematics.within_limits(move.joints_rad):
        joints = np.round(move.joints_rad, 3).tolist()
        raise JointLimitError(f"joints {joints} are not within ±360°")
    return MoveJoints(tuple(move.joints_rad.tolist()), move.speed_rps, move.acceleration_rps2)
