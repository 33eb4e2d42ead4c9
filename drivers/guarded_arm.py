"""Limits around any arm with the kinematics of a UR5: checked before motion, never during it.

This is not a safety function (the controller has its own); it keeps plans from asking for what
nobody wants.
"""

from dataclasses import dataclass, field
from itertools import pairwise
from types import TracebackType
from typing import Self

import numpy as np

from canopy_skel.geometry import FloatArray
from drivers import kinematics
from drivers.errors import SpeedCapError, WorkspaceError
from drivers.protocols import Arm, ArmState, LinearMove, Move

_STAYS_M = 0.001
"""A line that moves the flange by less only turns it."""


@dataclass(frozen=True, kw_only=True, slots=True)
class KeepOut:
    """Everything on the far side of a plane: points with normal · p < offset_m are forbidden.

    normal: unit vector in base, pointing to where the arm may be.
    """

    name: str
    normal: tuple[float, float, float]
    offset_m: float


@dataclass(frozen=True, kw_only=True, eq=False, slots=True)
class Limits:
    """What an arm may do.

    box_min_m, box_max_m: corners in base that the flange and the tool stay between. keep_outs:
    planes that elbow, wrist, flange and tool stay clear of. tool_points_in_tool0: (N, 3) outermost
    points of what the flange carries. body_radius_m: how far the arm's body reaches around the
    axes of its links; the lateral offset of a UR5's upper arm is about 0.14 m.
    """

    box_min_m: tuple[float, float, float]
    box_max_m: tuple[float, float, float]
    keep_outs: tuple[KeepOut, ...] = ()
    tool_points_in_tool0: FloatArray = field(default_factory=lambda: np.zeros((1, 3)))
    body_radius_m: float = 0.15
    speed_mps: float = 0.25
    acceleration_mps2: float = 0.5
    joint_speed_rps: float = 1.0
    joint_acceleration_rps2: float = 1.5


class GuardedArm:
    """An Arm that refuses, with the reason, whatever would leave its limits."""

    def __init__(self, arm: Arm, limits: Limits) -> None:
        self._arm = arm
        self._limits = limits

    def __enter__(self) -> Self:
        """Enter the arm."""
        self._arm.__enter__()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        """Leave the arm."""
        self._arm.__exit__(kind, error, traceback)

    def state(self) -> ArmState:
        """Return the state of the arm."""
        return self._arm.state()

    def check(self) -> None:
        """Raise what keeps the arm from moving."""
        self._arm.check()

    def stop(self) -> None:
        """Stop the arm."""
        self._arm.stop()

    def drop(self) -> None:
        """Drop the move of the arm."""
        self._arm.drop()

    def acknowledge(self, reason: str) -> None:
        """Acknowledge a stop of the arm."""
        self._arm.acknowledge(reason)

    def start_move(self, move: Move) -> None:
        """Begin a move that stays within the limits all the way; see `Arm.start_move`.

        Raises:
            SpeedCapError: it asks for more than the caps.
            WorkspaceError: the arm would leave the box or reach beyond a keep-out plane.
        """
        check(move, self._arm.state(), self._limits)
        self._arm.start_move(move)


def check(move: Move, state: ArmState, limits: Limits) -> None:
    """Raise the reason why a move that begins at `state` must not be made; return when it may.

    Raises:
        SpeedCapError, WorkspaceError: see `GuardedArm.start_move`.
        UnreachableError: the arm cannot follow the line at all.
    """
    _check_caps(move, limits)
    joints = _way(move, state)
    _check_rates(move, joints, _check_places(joints, limits), limits)


def tool_lead(base_from_tool0: FloatArray, state: ArmState, limits: Limits) -> float:
    """Return how many times as fast as the flange the tool's fastest point goes on a line; >= 1.

    A tool that turns on its way sweeps. Where the flange stays, controllers turn at the number they
    are given for the speed, in rad/s, and no point of the tool is a metre away.

    Raises:
        UnreachableError: the arm cannot follow the line at all.
    """
    if not limits.tool_points_in_tool0.any():
        return 1.0
    joints = kinematics.straight_joints(
        state.pose.base_from_tool0, base_from_tool0, state.joints_rad
    )
    shift_m = _shifts_m(_tool_points(joints, limits.tool_points_in_tool0))
    if shift_m[:, 0].sum() <= _STAYS_M:
        return 1.0
    return float((shift_m.max(axis=1) / shift_m[:, 0]).max())


def check_posture(joints_rad: FloatArray, limits: Limits) -> None:
    """Raise WorkspaceError if the arm must not stand with these joints (6,)."""
    _check_places(joints_rad[None], limits)


def _check_places(joints_rad: FloatArray, limits: Limits) -> FloatArray:
    """Check where the arm is with joints (N, 6); return its tool points (N, K, 3) in base."""
    body = kinematics.joint_origins(joints_rad)[:, 1:]
    tool = _tool_points(joints_rad, limits.tool_points_in_tool0)
    _check_box(tool, limits)
    for keep_out in limits.keep_outs:
        _check_plane(body, keep_out, limits.body_radius_m)
        _check_plane(tool, keep_out, 0.0)
    return tool


def _check_caps(move: Move, limits: Limits) -> None:
    if isinstance(move, LinearMove):
        _cap("speed", move.speed_mps, limits.speed_mps, "m/s")
        _cap("acceleration", move.acceleration_mps2, limits.acceleration_mps2, "m/s²")
    else:
        _cap("joint speed", move.speed_rps, limits.joint_speed_rps, "rad/s")
        _cap("joint acceleration", move.acceleration_rps2, limits.joint_acceleration_rps2, "rad/s²")


def _cap(name: str, asked: float, allowed: float, unit: str) -> None:
    if not asked <= allowed:
        raise SpeedCapError(f"{name} {asked:.3g} {unit} is over the cap of {allowed:.3g} {unit}")


def _way(move: Move, state: ArmState) -> FloatArray:
    """Return joints (N, 6) along the move."""
    if not isinstance(move, LinearMove):
        return kinematics.turned_joints(state.joints_rad, move.joints_rad)
    return kinematics.straight_joints(
        state.pose.base_from_tool0, move.base_from_tool0, state.joints_rad
    )


def _tool_points(joints_rad: FloatArray, points_in_tool0: FloatArray) -> FloatArray:
    """Return (N, K, 3): the flange and the K - 1 points of the tool, in base."""
    points = np.vstack([np.zeros((1, 3)), points_in_tool0])
    poses = np.array([kinematics.forward(joints) for joints in joints_rad])
    turned: FloatArray = np.einsum("nij,kj->nki", poses[:, :3, :3], points)
    shifted: FloatArray = turned + poses[:, None, :3, 3]
    return shifted


def _check_box(points_in_base: FloatArray, limits: Limits) -> None:
    outside = (points_in_base < limits.box_min_m) | (points_in_base > limits.box_max_m)
    if outside.any():
        worst = points_in_base[np.nonzero(outside.any(axis=2))][0]
        raise WorkspaceError(
            f"the tool would be at {_text(worst)}, outside the workspace box"
            f" {_text(limits.box_min_m)} to {_text(limits.box_max_m)}"
        )


def _check_plane(points_in_base: FloatArray, keep_out: KeepOut, clearance_m: float) -> None:
    distance_m = points_in_base @ np.asarray(keep_out.normal) - keep_out.offset_m
    if (distance_m < clearance_m).any():
        worst = points_in_base.reshape(-1, 3)[np.argmin(distance_m)]
        raise WorkspaceError(
            f"the arm would be at {_text(worst)}, {clearance_m - distance_m.min():.3f} m too close"
            f" to keep-out '{keep_out.name}'"
        )


def _check_rates(move: Move, joints_rad: FloatArray, tool: FloatArray, limits: Limits) -> None:
    """Check what the caps on one space mean in the other: joints on lines, tool on joint moves."""
    turn_rad = np.abs(np.diff(joints_rad, axis=0)).max(axis=1)
    shift_m = _shifts_m(tool)
    if isinstance(move, LinearMove):
        step_s = _steps_s(joints_rad, shift_m[:, 0], move.speed_mps)
        fastest = _fastest(turn_rad, step_s)
        _cap("a joint's speed on this line,", fastest, limits.joint_speed_rps, "rad/s,")
        fastest = _fastest(shift_m.max(axis=1), step_s)
        _cap("the tool's speed on this line,", fastest, limits.speed_mps, "m/s,")
    else:
        fastest = _fastest(shift_m.max(axis=1), turn_rad / move.speed_rps)
        _cap("the tool's speed on this joint move,", fastest, limits.speed_mps, "m/s,")


def _steps_s(joints_rad: FloatArray, shift_m: FloatArray, speed_mps: float) -> FloatArray:
    """Return how long each step of a line takes whose flange moves by `shift_m` (N - 1,).

    Where the flange stays, controllers turn at the number they are given for the speed, in rad/s.
    """
    if shift_m.sum() > _STAYS_M:
        return shift_m / speed_mps
    poses = [kinematics.forward(joints) for joints in joints_rad]
    turns = [kinematics.relative_turn(*pair) for pair in pairwise(poses)]
    turn_rad = np.linalg.norm([kinematics.rotation_vector(turn) for turn in turns], axis=1)
    slower: FloatArray = np.maximum(turn_rad, shift_m)
    return slower / speed_mps


def _shifts_m(tool: FloatArray) -> FloatArray:
    """Return how far flange and tool points (N, K, 3) move in each step, (N - 1, K)."""
    shifts: FloatArray = np.linalg.norm(np.diff(tool, axis=0), axis=2)
    return shifts


def _fastest(way: FloatArray, duration_s: FloatArray) -> float:
    moving = duration_s > 1e-6
    return float((way[moving] / duration_s[moving]).max(initial=0.0))


def _text(point: FloatArray | tuple[float, ...]) -> str:
    return "(" + ", ".join(f"{value:.3f}" for value in point) + ") m"
