"""Where a UR5 stands for given joints, and the joints for a given place.

Nominal kinematics only: every real arm differs from them by its factory calibration (about a
millimetre), so poses that are recorded come from the controller and these functions plan.
Denavit-Hartenberg values: UR5 user manual, series 3.

The closed form rests on the shape of the arm: joints 2, 3 and 4 are parallel, so wrist 1 lies in
a plane that turns with the base, and the way there is a planar arm of two links. (`ur-analytic-ik`
does the same, but loses all solutions in postures of exact right angles, the usual home pose.)
"""

import math
from collections.abc import Iterable, Sequence
from math import atan2, cos, sin

import numpy as np

from canopy_skel.geometry import FloatArray, rotation_from_quaternion, transform_from
from drivers.errors import UnreachableError

JOINT_LIMIT_RAD = 2 * math.pi
"""A UR5 joint turns at most one full turn to each side."""

_D_M = (0.089159, 0.0, 0.0, 0.10915, 0.09465, 0.0823)
_A_M = (0.0, -0.425, -0.39225, 0.0, 0.0, 0.0)
_ALPHA_RAD = (math.pi / 2, 0.0, 0.0, math.pi / 2, -math.pi / 2, 0.0)
_LARGEST_STEP_RAD = 0.6
_FINE_STEP_RAD = 0.1
"""Of a joint near a singularity, where its speed changes quickly: the mean over less is near it."""
_FINEST_FRACTION = 1e-6
_BENT = 1e-3
_STRAIGHT = 1e-9


def forward(joints_rad: Sequence[float] | FloatArray) -> FloatArray:
    """Return base_from_tool0, the (4, 4) pose of the tool flange for six joint angles."""
    q1, q2, q3, q4, q5, q6 = map(float, joints_rad)
    c1, s1, c5, s5, c6, s6 = cos(q1), sin(q1), cos(q5), sin(q5), cos(q6), sin(q6)
    c234, s234 = cos(q2 + q3 + q4), sin(q2 + q3 + q4)
    out_m = _A_M[1] * cos(q2) + _A_M[2] * cos(q2 + q3)
    up_m = _A_M[1] * sin(q2) + _A_M[2] * sin(q2 + q3) + _D_M[0]
    x4 = (c234 * c1, c234 * s1, s234)
    y4 = (s1, -c1, 0.0)
    z4 = (s234 * c1, s234 * s1, -c234)
    wrist = (out_m * c1 + _D_M[3] * s1, out_m * s1 - _D_M[3] * c1, up_m)
    pose = np.eye(4)
    for i in range(3):
        x5, y5, z5 = c5 * x4[i] + s5 * y4[i], -z4[i], c5 * y4[i] - s5 * x4[i]
        pose[i, 0], pose[i, 1], pose[i, 2] = c6 * x5 + s6 * y5, c6 * y5 - s6 * x5, z5
        pose[i, 3] = wrist[i] + _D_M[4] * z4[i] + _D_M[5] * z5
    return pose


def joint_origins(joints_rad: FloatArray) -> FloatArray:
    """Return the origins of the six link frames in base for (N, 6) joints: (N, 6, 3) metres.

    Index 0 is the shoulder, 1 the elbow, 2 and 3 the wrist, 5 the tool flange.
    """
    base_from_link = np.broadcast_to(np.eye(4), (len(joints_rad), 4, 4))
    origins = np.empty((len(joints_rad), 6, 3))
    for joint, (d_m, a_m, alpha_rad) in enumerate(zip(_D_M, _A_M, _ALPHA_RAD, strict=True)):
        c, s = np.cos(joints_rad[:, joint]), np.sin(joints_rad[:, joint])
        ca, sa = cos(alpha_rad), sin(alpha_rad)
        step = np.zeros((len(joints_rad), 4, 4))
        step[:, 0] = np.stack([c, -s * ca, s * sa, a_m * c], axis=-1)
        step[:, 1] = np.stack([s, c * ca, -c * sa, a_m * s], axis=-1)
        step[:, 2] = (0.0, sa, ca, d_m)
        step[:, 3, 3] = 1.0
        base_from_link = base_from_link @ step
        origins[:, joint] = base_from_link[:, :3, 3]
    return origins


def inverse(
    base_from_tool0: FloatArray, near_joints_rad: Sequence[float] | FloatArray
) -> FloatArray | None:
    """Return the joints (6,) that reach a pose with the least turning from `near_joints_rad`.

    None: no solution within reach; see `inverses`.
    """
    return next(iter(inverses(base_from_tool0, near_joints_rad)), None)


def inverses(
    base_from_tool0: FloatArray, near_joints_rad: Sequence[float] | FloatArray
) -> list[FloatArray]:
    """Return all joints (6,) that reach a pose, those with the least turning first.

    Whole turns are chosen per joint within ±360°. Where the wrist is straight (joints 4 and 6
    parallel) joint 6 stays as it is.
    """
    near = [float(joint) for joint in near_joints_rad]
    found = [
        [_wound(joint, beside) for joint, beside in zip(solution, near, strict=True)]
        for solution in _solutions(base_from_tool0.tolist(), near[5])
    ]

    def turning_rad(joints: list[float]) -> float:
        return max(abs(joint - beside) for joint, beside in zip(joints, near, strict=True))

    return [np.array(joints) for joints in sorted(found, key=turning_rad)]


def _wound(joint_rad: float, near_rad: float) -> float:
    """Return the angle plus those whole turns that bring it nearest within ±360°."""
    wound = joint_rad + math.tau * round((near_rad - joint_rad) / math.tau)
    return wound if abs(wound) <= JOINT_LIMIT_RAD else wound - math.copysign(math.tau, wound)


def _solutions(pose: list[list[float]], near_q6: float) -> list[tuple[float, ...]]:
    """Return all joints that reach a pose, up to two each for shoulder, wrist and elbow."""
    (x6, y6, z6, p6) = (tuple(row[column] for row in pose[:3]) for column in range(4))
    p5 = tuple(p6[i] - _D_M[5] * z6[i] for i in range(3))
    radius_m = math.hypot(p5[0], p5[1])
    if radius_m < _D_M[3] - _STRAIGHT:
        return []
    aside_rad = math.acos(min(1.0, _D_M[3] / radius_m))
    found: list[tuple[float, ...]] = []
    for shoulder in (1, -1):
        q1 = atan2(p5[1], p5[0]) + shoulder * aside_rad + math.pi / 2
        c1, s1 = cos(q1), sin(q1)
        along_x, along_y = x6[0] * s1 - x6[1] * c1, y6[0] * s1 - y6[1] * c1
        bend = math.hypot(along_x, along_y)
        for wrist in (1, -1):
            q5 = atan2(wrist * bend, z6[0] * s1 - z6[1] * c1)
            straight = bend < _STRAIGHT
            q6 = near_q6 if straight else atan2(-wrist * along_y, wrist * along_x)
            c5, s5, c6, s6 = cos(q5), sin(q5), cos(q6), sin(q6)
            y5 = tuple(s6 * x6[i] + c6 * y6[i] for i in range(3))
            x4 = tuple(c5 * (c6 * x6[i] - s6 * y6[i]) - s5 * z6[i] for i in range(3))
            p4 = tuple(p5[i] + _D_M[4] * y5[i] for i in range(3))
            q234 = atan2(x4[2], x4[0] * c1 + x4[1] * s1)
            for q2, q3 in _elbows(p4[0] * c1 + p4[1] * s1, p4[2] - _D_M[0]):
                found.append((q1, q2, q3, q234 - q2 - q3, q5, q6))
    return found


def _elbows(out_m: float, up_m: float) -> list[tuple[float, float]]:
    """Return joints 2 and 3 that bring the end of the forearm to a point of the arm's plane."""
    upper, fore = _A_M[1], _A_M[2]
    bend = (out_m * out_m + up_m * up_m - upper * upper - fore * fore) / (2 * upper * fore)
    if abs(bend) > 1.0 + _STRAIGHT:
        return []
    bent_rad = math.acos(max(-1.0, min(1.0, bend)))
    return [
        (atan2(up_m, out_m) - atan2(fore * sin(q3), upper + fore * cos(q3)), q3)
        for q3 in (bent_rad, -bent_rad)
    ]


def within_limits(joints_rad: Iterable[float]) -> bool:
    """Say whether every joint is finite and inside ±360°."""
    return all(math.isfinite(q) and abs(q) <= JOINT_LIMIT_RAD + 1e-9 for q in joints_rad)


def straight_joints(
    base_from_start: FloatArray,
    base_from_end: FloatArray,
    near_joints_rad: FloatArray,
    step_m: float = 0.02,
) -> FloatArray:
    """Return joints (N, 6) along the straight line between two tool0 poses, both ends included.

    One sample for each `step_m` and each 0.1 rad of turn; more where joints turn fast.

    Raises:
        UnreachableError: the end is out of reach, or the line leaves the reach or passes so close
            to a singularity, or to ±360° of a joint, that one would turn more than 0.6 rad
            within one step, or leads through a straight wrist.
    """
    goal = "({:.3f}, {:.3f}, {:.3f}) m".format(*base_from_end[:3, 3])
    if inverse(base_from_end, near_joints_rad) is None:
        raise UnreachableError(f"no joints bring the tool to {goal}")
    length_m = float(np.linalg.norm(base_from_end[:3, 3] - base_from_start[:3, 3]))
    turn_rad = float(np.linalg.norm(rotation_vector(relative_turn(base_from_start, base_from_end))))
    steps = max(2, math.ceil(length_m / step_m), math.ceil(turn_rad / 0.1))
    path, there = [np.asarray(near_joints_rad, dtype=np.float64)], 0.0
    ahead = np.linspace(1.0, 0.0, steps + 1).tolist()
    while ahead:
        joints = inverse(interpolate(base_from_start, base_from_end, ahead[-1]), path[-1])
        step_rad = math.inf if joints is None else float(np.abs(joints - path[-1]).max())
        if joints is None or step_rad > _LARGEST_STEP_RAD:
            raise _no_line(goal)
        if step_rad > _FINE_STEP_RAD and ahead[-1] - there > _FINEST_FRACTION:
            ahead.append((there + ahead[-1]) / 2)
            continue
        path.append(joints)
        there = ahead.pop()
    if _through_straight_wrist(np.asarray(path[1:])):
        raise _no_line(goal)
    return np.asarray(path[1:])


def _no_line(goal: str) -> UnreachableError:
    return UnreachableError(
        f"the straight line to {goal} leaves the reach of the arm, passes a singularity or"
        " would turn a joint beyond ±360°: make a joint move or go over another waypoint"
    )


def _through_straight_wrist(path: FloatArray) -> bool:
    """Say whether joint 5 goes through 0° or 180°, where joints 4 and 6 may whirl between samples.

    Of two postures the nearer one is taken for the next sample, which is the one that passes; a
    controller that keeps to its own turns two joints by half a turn at that point.
    """
    bend = np.sin(path[:, 4])
    return bool((bend < -_BENT).any() and (bend > _BENT).any())


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
    """Return the axis of a (3, 3) rotation times its angle in radians, (3,).

    Through the quaternion whose largest part is found first (Shepperd 1978), so that half turns,
    a tool pointing straight down for one, are as exact as any other.
    """
    (a, b, c), (d, e, f), (g, h, i) = rotation.tolist()
    quaternion = max(
        (1 + a - e - i, (1 + a - e - i, b + d, c + g, h - f)),
        (1 - a + e - i, (b + d, 1 - a + e - i, f + h, c - g)),
        (1 - a - e + i, (c + g, f + h, 1 - a - e + i, d - b)),
        (1 + a + e + i, (h - f, c - g, d - b, 1 + a + e + i)),
    )[1]
    x, y, z, w = quaternion if quaternion[3] >= 0 else (-part for part in quaternion)
    length = math.hypot(x, y, z)
    scale = 2 * atan2(length, w) / length if length > 0 else 0.0
    return np.array([scale * x, scale * y, scale * z])


def rotation_from_vector(vector_rad: FloatArray) -> FloatArray:
    """Return the (3, 3) rotation about the direction of a (3,) vector by its length in radians."""
    x, y, z = vector_rad.tolist()
    angle_rad = math.hypot(x, y, z)
    scale = sin(angle_rad / 2) / angle_rad if angle_rad > 0 else 0.0
    return rotation_from_quaternion((scale * x, scale * y, scale * z, cos(angle_rad / 2)))


def pose_from_transform(transform: FloatArray) -> tuple[float, ...]:
    """Return (x, y, z, rx, ry, rz) in metres and radians, as UR controllers write poses."""
    return (*transform[:3, 3].tolist(), *rotation_vector(transform[:3, :3]).tolist())


def transform_from_pose(pose: Sequence[float]) -> FloatArray:
    """Return the (4, 4) transform of a UR pose (x, y, z, rx, ry, rz)."""
    return transform_from(rotation_from_vector(np.asarray(pose[3:6], dtype=np.float64)), pose[:3])
