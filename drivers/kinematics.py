"""Where a UR5 stands for given joints, and the joints for a given place.

Nominal kinematics only: every real arm differs from them by its factory calibration (about a
millimetre), so poses that are recorded come from the controller and these functions plan.
Denavit-Hartenberg values: UR5 user manual, series 3. Closed-form inverse: `ur-analytic-ik`.
"""

import math
from collections.abc import Iterable, Sequence

import numpy as np
from scipy.spatial.transform import Rotation
from ur_analytic_ik import ur5

from canopy_skel.geometry import FloatArray, transform_from

JOINT_LIMIT_RAD = 2 * math.pi
"""A UR5 joint turns at most one full turn to each side."""

_D_M = (0.089159, 0.0, 0.0, 0.10915, 0.09465, 0.0823)
_A_M = (0.0, -0.425, -0.39225, 0.0, 0.0, 0.0)
_ALPHA_RAD = (math.pi / 2, 0.0, 0.0, math.pi / 2, -math.pi / 2, 0.0)
_LARGEST_STEP_RAD = 0.6


def forward(joints_rad: Sequence[float] | FloatArray) -> FloatArray:
    """Return base_from_tool0, the (4, 4) pose of the tool flange for six joint angles."""
    pose: FloatArray = ur5.forward_kinematics(*map(float, joints_rad))
    return pose


def joint_origins(joints_rad: FloatArray) -> FloatArray:
    """Return the origins of the six link frames in base for (N, 6) joints: (N, 6, 3) metres.

    Index 0 is the shoulder, 1 the elbow, 2 and 3 the wrist, 5 the tool flange.
    """
    base_from_link = np.broadcast_to(np.eye(4), (len(joints_rad), 4, 4))
    origins = np.empty((len(joints_rad), 6, 3))
    for joint, (d_m, a_m, alpha_rad) in enumerate(zip(_D_M, _A_M, _ALPHA_RAD, strict=True)):
        cos, sin = np.cos(joints_rad[:, joint]), np.sin(joints_rad[:, joint])
        ca, sa = math.cos(alpha_rad), math.sin(alpha_rad)
        step = np.zeros((len(joints_rad), 4, 4))
        step[:, 0] = np.stack([cos, -sin * ca, sin * sa, a_m * cos], axis=-1)
        step[:, 1] = np.stack([sin, cos * ca, -cos * sa, a_m * sin], axis=-1)
        step[:, 2] = (0.0, sa, ca, d_m)
        step[:, 3, 3] = 1.0
        base_from_link = base_from_link @ step
        origins[:, joint] = base_from_link[:, :3, 3]
    return origins


def inverse(
    base_from_tool0: FloatArray, near_joints_rad: Sequence[float] | FloatArray
) -> FloatArray | None:
    """Return the joints (6,) that reach a pose with the least turning from `near_joints_rad`.

    Whole turns are chosen per joint within ±360°. None: no solution within reach.
    """
    solutions = ur5.inverse_kinematics(np.ascontiguousarray(base_from_tool0))
    if not solutions:
        return None
    near = np.asarray(near_joints_rad, dtype=np.float64)
    joints = np.asarray(solutions)
    joints = joints + 2 * math.pi * np.round((near - joints) / (2 * math.pi))
    joints = np.where(
        np.abs(joints) <= JOINT_LIMIT_RAD, joints, joints - np.sign(joints) * math.tau
    )
    best: FloatArray = joints[np.argmin(np.abs(joints - near).max(axis=1))]
    return best


def within_limits(joints_rad: Iterable[float]) -> bool:
    """Say whether every joint is finite and inside ±360°."""
    return all(math.isfinite(q) and abs(q) <= JOINT_LIMIT_RAD + 1e-9 for q in joints_rad)


def straight_joints(
    base_from_start: FloatArray,
    base_from_end: FloatArray,
    near_joints_rad: FloatArray,
    step_m: float = 0.02,
) -> FloatArray | None:
    """Return joints (N, 6) along the straight line between two tool0 poses, both ends included.

    None where the line leaves the reach of the arm, or passes so close to a singularity that a
    joint would turn more than 0.6 rad within one step.
    """
    length_m = float(np.linalg.norm(base_from_end[:3, 3] - base_from_start[:3, 3]))
    turn_rad = float(np.linalg.norm(rotation_vector(relative_turn(base_from_start, base_from_end))))
    steps = max(2, math.ceil(length_m / step_m), math.ceil(turn_rad / 0.1))
    path = [np.asarray(near_joints_rad, dtype=np.float64)]
    for fraction in np.linspace(0.0, 1.0, steps + 1):
        joints = inverse(interpolate(base_from_start, base_from_end, float(fraction)), path[-1])
        if joints is None or np.abs(joints - path[-1]).max() > _LARGEST_STEP_RAD:
            return None
        path.append(joints)
    return np.asarray(path[1:])


def turned_joints(start_rad: FloatArray, end_rad: FloatArray, step_rad: float = 0.05) -> FloatArray:
    """Return joints (N, 6) on the way from start to end, all joints turning in proportion."""
    steps = max(1, math.ceil(float(np.abs(end_rad - start_rad).max()) / step_rad))
    return start_rad + np.linspace(0.0, 1.0, steps + 1)[:, None] * (end_rad - start_rad)


def interpolate(
    base_from_start: FloatArray, base_from_end: FloatArray, fraction: float
) -> FloatArray:
    """Return the pose at `fraction` of the straight line, turning evenly about one axis."""
    turn = rotation_vector(relative_turn(base_from_start, base_from_end))
    rotation = base_from_start[:3, :3] @ rotation_from_vector(fraction * turn)
    start_m, end_m = base_from_start[:3, 3], base_from_end[:3, 3]
    return transform_from(rotation, start_m + fraction * (end_m - start_m))


def relative_turn(base_from_a: FloatArray, base_from_b: FloatArray) -> FloatArray:
    """Return the (3, 3) rotation that turns pose a into pose b, expressed in a."""
    turn: FloatArray = base_from_a[:3, :3].T @ base_from_b[:3, :3]
    return turn


def rotation_vector(rotation: FloatArray) -> FloatArray:
    """Return the axis of a (3, 3) rotation times its angle in radians, (3,)."""
    return Rotation.from_matrix(rotation, assume_valid=True).as_rotvec()


def rotation_from_vector(vector_rad: FloatArray) -> FloatArray:
    """Return the (3, 3) rotation about the direction of a (3,) vector by its length in radians."""
    return Rotation.from_rotvec(vector_rad).as_matrix()


def pose_from_transform(transform: FloatArray) -> tuple[float, ...]:
    """Return (x, y, z, rx, ry, rz) in metres and radians, as UR controllers write poses."""
    return (*transform[:3, 3].tolist(), *rotation_vector(transform[:3, :3]).tolist())


def transform_from_pose(pose: Sequence[float]) -> FloatArray:
    """Return the (4, 4) transform of a UR pose (x, y, z, rx, ry, rz)."""
    return transform_from(rotation_from_vector(np.asarray(pose[3:6], dtype=np.float64)), pose[:3])
