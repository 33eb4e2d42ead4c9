"""An arm that can be at the places of a recording and nowhere else."""

import threading
import time
from dataclasses import dataclass
from types import TracebackType
from typing import Self

import numpy as np

from canopy_skel.errors import UsageError
from canopy_skel.geometry import FloatArray
from drivers import kinematics
from drivers.errors import ArmBusyError, JointLimitError, NotConnectedError, UnreachableError
from drivers.protocols import ArmMode, ArmState, JointMove, LinearMove, Move, ToolPose
from mock_hw.replay.track import Track


@dataclass(frozen=True, kw_only=True, eq=False, slots=True)
class _Way:
    """A move under way: from the pose `start` with its joints to the move's target with its."""

    move: Move
    start: FloatArray
    start_joints: FloatArray
    end_joints: FloatArray
    began_s: float
    duration_s: float


class ReplayArm:
    """An arm whose reachable poses are those of a recording's views; see `drivers.protocols.Arm`.

    It stands at the first view when it is made, moves at the commanded speed without ramps, and
    has the nominal joints of a UR5 (NaN where a UR5 would not reach).

    Args:
        track: where it can be.
        time_scale: how many times faster than commanded it moves.

    Raises:
        UsageError: the time scale is not above 0.
    """

    def __init__(self, track: Track, *, time_scale: float = 1.0) -> None:
        if not time_scale > 0:
            raise UsageError(f"time_scale is {time_scale}; it must be above 0")
        self._track = track
        self._time_scale = time_scale
        self._lock = threading.Lock()
        self._connected = False
        self._pose = track.stations[0].base_from_tool0
        self._joints = _joints_at(self._pose, np.zeros(6))
        self._way: _Way | None = None
        self._interrupted = False
        self._stamp_ns = 0

    def __enter__(self) -> Self:
        """Connect."""
        with self._lock:
            self._connected, self._interrupted = True, False
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        """Stop and disconnect."""
        with self._lock:
            self._halt()
            self._connected = False

    def state(self) -> ArmState:
        """Return where the arm is now."""
        with self._lock:
            self._advance()
            way = self._way
            speeds, tool_speed_mps = (np.zeros(6), 0.0) if way is None else _speeds(way)
            return ArmState(
                pose=ToolPose(stamp_ns=self._stamp_ns, base_from_tool0=self._pose),
                joints_rad=self._joints,
                joint_speeds_rps=speeds,
                tool_speed_mps=tool_speed_mps,
                mode=self._mode(),
                detail="stopped on request" if self._interrupted else "",
            )

    def pose(self) -> ToolPose:
        """Return where the flange is now."""
        return self.state().pose

    def check(self) -> None:
        """Raise NotConnectedError outside the `with` block; nothing else holds this arm."""
        with self._lock:
            self._ensure_connected()

    def start_move(self, move: Move) -> None:
        """Begin a move to the pose of a view; see `Arm.start_move`.

        Raises:
            UnreachableError: the recording has no view there.
            JointLimitError: the joints are outside ±360°.
            ArmBusyError: a move is under way.
            NotConnectedError: outside the `with` block.
        """
        with self._lock:
            self._advance()
            if self._way is not None:
                raise ArmBusyError("a move is under way: wait for its end or stop it")
            self._check(move)
            self._way = self._way_to(move)
            self._interrupted = False

    def stop(self) -> None:
        """Stand still at once, wherever that is."""
        with self._lock:
            self._halt()

    def drop(self) -> None:
        """Stand still at once: no other moves this arm."""
        self.stop()

    def acknowledge(self, reason: str) -> None:
        """Do nothing: nothing holds this arm."""
        with self._lock:
            self._ensure_connected()

    # Under the lock

    def _ensure_connected(self) -> None:
        if not self._connected:
            raise NotConnectedError("the arm is not connected: use it inside its `with` block")

    def _advance(self) -> None:
        """Bring pose, joints and stamp to now."""
        self._ensure_connected()
        now_ns = time.monotonic_ns()
        self._stamp_ns = max(now_ns, self._stamp_ns + 1)
        if self._way is None:
            return
        way = self._way
        share = min(1.0, (time.perf_counter() - way.began_s) / max(way.duration_s, 1e-9))
        self._pose, self._joints = _along(way, share)
        if share >= 1.0:
            self._way = None

    def _halt(self) -> None:
        if not self._connected:
            return
        self._advance()
        if self._way is not None:
            self._way, self._interrupted = None, True

    def _mode(self) -> ArmMode:
        if self._way is not None:
            return ArmMode.MOVING
        return ArmMode.INTERRUPTED if self._interrupted else ArmMode.READY

    def _check(self, move: Move) -> None:
        if isinstance(move, JointMove) and not kinematics.within_limits(move.joints_rad):
            joints = np.round(move.joints_rad, 3).tolist()
            raise JointLimitError(f"joints {joints} are not within ±360°")
        target = _target(move)
        if not self._track.at(target):
            nearest, away_m = self._track.nearest_m(target)
            x, y, z = target[:3, 3]
            raise UnreachableError(
                f"{self._track.recording.path.name} has no view from ({x:.3f}, {y:.3f}, {z:.3f}) m"
                f" with that direction; the nearest is view {nearest.index}, {away_m:.3f} m away"
            )

    def _way_to(self, move: Move) -> _Way:
        target = _target(move)
        joints = (
            move.joints_rad if isinstance(move, JointMove) else _joints_at(target, self._joints)
        )
        return _Way(
            move=move,
            start=self._pose,
            start_joints=self._joints,
            end_joints=joints,
            began_s=time.perf_counter(),
            duration_s=_duration_s(move, self._pose, self._joints) / self._time_scale,
        )


def _target(move: Move) -> FloatArray:
    if isinstance(move, LinearMove):
        return move.base_from_tool0
    return kinematics.forward(move.joints_rad)


def _joints_at(base_from_tool0: FloatArray, near_joints_rad: FloatArray) -> FloatArray:
    joints = kinematics.inverse(base_from_tool0, np.nan_to_num(near_joints_rad))
    return np.full(6, np.nan) if joints is None else joints


def _duration_s(move: Move, start: FloatArray, start_joints: FloatArray) -> float:
    """Return how long a move takes; where a line only turns, radians count as metres."""
    if isinstance(move, JointMove):
        return float(np.abs(move.joints_rad - np.nan_to_num(start_joints)).max() / move.speed_rps)
    shift_m = float(np.linalg.norm(move.base_from_tool0[:3, 3] - start[:3, 3]))
    turn = kinematics.relative_turn(start, move.base_from_tool0)
    turn_rad = float(np.linalg.norm(kinematics.rotation_vector(turn)))
    return (shift_m if shift_m > 1e-9 else turn_rad) / move.speed_mps


def _along(way: _Way, share: float) -> tuple[FloatArray, FloatArray]:
    """Return pose and joints after a share of the way; at its end exactly those of its target."""
    if share >= 1.0:
        return _target(way.move), way.end_joints
    if isinstance(way.move, LinearMove):
        pose = kinematics.interpolate(way.start, way.move.base_from_tool0, share)
        return pose, _joints_at(pose, way.start_joints)
    joints = way.start_joints + share * (way.end_joints - way.start_joints)
    return kinematics.forward(joints), joints


def _speeds(way: _Way) -> tuple[FloatArray, float]:
    """Return the mean speeds of the joints (6,) and of the flange in m/s."""
    duration_s = max(way.duration_s, 1e-9)
    shift_m = float(np.linalg.norm(_target(way.move)[:3, 3] - way.start[:3, 3]))
    return (way.end_joints - way.start_joints) / duration_s, shift_m / duration_s
