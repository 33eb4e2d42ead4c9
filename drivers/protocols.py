"""What an arm and a camera are to the rest of the program, whatever stands behind them."""

import math
import time
from dataclasses import dataclass
from enum import Enum
from types import TracebackType
from typing import Protocol, Self

import numpy as np

from canopy_skel.frame import Float32Array, Intrinsics, StereoPair, UInt8Array, UInt16Array
from canopy_skel.geometry import FloatArray, is_rigid
from drivers.errors import (
    ArmBusyError,
    ArmError,
    EmergencyStopError,
    MoveInterruptedError,
    MoveRefusedError,
    NotAcknowledgedError,
    NotPoweredError,
    ProtectiveStopError,
    SafeguardStopError,
    SafetyFaultError,
    SettleTimeoutError,
)


class ArmMode(Enum):
    """What an arm can do next."""

    READY = "ready"
    MOVING = "moving"
    INTERRUPTED = "interrupted"
    PROTECTIVE_STOP = "protective stop"
    SAFEGUARD_STOP = "safeguard stop"
    EMERGENCY_STOP = "emergency stop"
    SAFETY_FAULT = "safety fault"
    NOT_POWERED = "not powered"
    NOT_ACKNOWLEDGED = "not acknowledged"


_ERRORS: dict[ArmMode, type[ArmError]] = {
    ArmMode.MOVING: ArmBusyError,
    ArmMode.INTERRUPTED: MoveInterruptedError,
    ArmMode.PROTECTIVE_STOP: ProtectiveStopError,
    ArmMode.SAFEGUARD_STOP: SafeguardStopError,
    ArmMode.EMERGENCY_STOP: EmergencyStopError,
    ArmMode.SAFETY_FAULT: SafetyFaultError,
    ArmMode.NOT_POWERED: NotPoweredError,
    ArmMode.NOT_ACKNOWLEDGED: NotAcknowledgedError,
}


@dataclass(frozen=True, kw_only=True, eq=False, slots=True)
class ToolPose:
    """Where the tool flange was, and when.

    stamp_ns: host time (`time.monotonic_ns`, the clock of the cameras too) at which the
    controller measured. base_from_tool0: (4, 4), maps points of the flange frame into base.
    """

    stamp_ns: int
    base_from_tool0: FloatArray


@dataclass(frozen=True, kw_only=True, eq=False, slots=True)
class ArmState:
    """One measurement of an arm; all parts belong to the same instant.

    joints_rad, joint_speeds_rps: (6,). tool_speed_mps: length of the flange's velocity.
    detail: one line that says more about `mode`, empty where there is nothing to say.
    """

    pose: ToolPose
    joints_rad: FloatArray
    joint_speeds_rps: FloatArray
    tool_speed_mps: float
    mode: ArmMode
    detail: str = ""


@dataclass(frozen=True, kw_only=True, eq=False, slots=True)
class LinearMove:
    """Move the flange straight to a (4, 4) pose, turning evenly on the way.

    Raises:
        MoveRefusedError: the numbers make no move.
    """

    base_from_tool0: FloatArray
    speed_mps: float
    acceleration_mps2: float

    def __post_init__(self) -> None:
        """Check the numbers once; trusted afterwards."""
        if not is_rigid(self.base_from_tool0):
            raise MoveRefusedError(
                "base_from_tool0 is not a rigid (4, 4) transform: check the plan"
            )
        _check_positive(speed=self.speed_mps, acceleration=self.acceleration_mps2)


@dataclass(frozen=True, kw_only=True, eq=False, slots=True)
class JointMove:
    """Turn all joints in proportion to (6,) angles; speeds are those of the leading joint.

    Raises:
        MoveRefusedError: the numbers make no move.
    """

    joints_rad: FloatArray
    speed_rps: float
    acceleration_rps2: float

    def __post_init__(self) -> None:
        """Check the numbers once; trusted afterwards."""
        if self.joints_rad.shape != (6,) or not np.isfinite(self.joints_rad).all():
            raise MoveRefusedError("joints_rad are not six finite angles: check the plan")
        _check_positive(speed=self.speed_rps, acceleration=self.acceleration_rps2)


Move = LinearMove | JointMove


class Arm(Protocol):
    """A robot arm. Entering connects and moves nothing; leaving stops and disconnects.

    Every method may be called from any thread. After `stop`, after a safety stop and after a
    lost connection the pending motion is gone: only a new `start_move` moves the arm again, and
    after anything but a plain `stop` it is refused until `acknowledge`.
    """

    def __enter__(self) -> Self:
        """Connect, or raise ArmLinkError and leave nothing open."""
        ...

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        """Stop, disconnect; harmless when repeated."""
        ...

    def state(self) -> ArmState:
        """Return the newest measurement; never an old one: ArmLinkError when there is none."""
        ...

    def check(self) -> None:
        """Raise what would keep the arm from beginning a move now; a move under way does not count.

        Raises:
            ArmStoppedError: the arm is held, or takes no commands; the message names the mend.
            ArmLinkError: the arm cannot be asked.
        """
        ...

    def start_move(self, move: Move) -> None:
        """Begin a move and return; the mode is MOVING until it ends.

        Raises:
            MoveRefusedError: nothing moves (unreachable, over a limit, busy, …).
            ArmStoppedError: the arm is held; see `acknowledge`.
            ArmLinkError: the arm cannot be asked.
        """
        ...

    def stop(self) -> None:
        """Brake now and forget the move under way, whoever began it; harmless when nothing moves.

        Raises:
            ArmLinkError: no way to the controller is left; the emergency stop must be used.
        """
        ...

    def drop(self) -> None:
        """Stop what this arm was told to do, where nobody asked: another's motion is left alone.

        Raises:
            ArmLinkError: no way to the controller is left; the emergency stop must be used.
        """
        ...

    def acknowledge(self, reason: str) -> None:
        """Let the arm move again after a stop: an operator has looked and says why it is safe.

        Raises:
            ArmStoppedError: the cause is still there; the message says what to do.
            ArmLinkError: the arm cannot be asked.
        """
        ...


@dataclass(frozen=True, kw_only=True, eq=False, slots=True)
class CameraImage:
    """One exposure.

    stamp_ns: the middle of the exposure on the host clock (`time.monotonic_ns`). color_rgb:
    (H, W, 3) uint8. depth_m: (H, W) float32 aligned to colour, NaN = no return. instances,
    scores: branch masks of cameras that know them (simulated, replayed), as in `View`. All arrays
    are read-only.
    """

    stamp_ns: int
    color_rgb: UInt8Array
    intrinsics: Intrinsics
    depth_m: Float32Array | None = None
    stereo: StereoPair | None = None
    instances: UInt16Array | None = None
    scores: tuple[float, ...] | None = None

    def __post_init__(self) -> None:
        """Let nobody change what was seen."""
        pair = self.stereo
        sides = (None, None) if pair is None else (pair.left_mono, pair.right_mono)
        for array in (self.color_rgb, self.depth_m, self.instances, *sides):
            if array is not None:
                array.setflags(write=False)


class Camera(Protocol):
    """A camera on the arm's flange. Entering opens it."""

    def __enter__(self) -> Self:
        """Open the camera, or raise NoCameraError and leave nothing open."""
        ...

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        """Close the camera; harmless when repeated."""
        ...

    def check(self) -> None:
        """Raise NoCameraError if the camera is known to be gone; returns at once.

        One that is gone is tried anew, so a later call may find it back.
        """
        ...

    def grab(self, timeout_s: float) -> CameraImage:
        """Return a picture whose exposure began after this call.

        Raises:
            CameraTimeoutError: none came within `timeout_s`.
            NoCameraError: not inside the `with` block, or the camera is gone.
        """
        ...


@dataclass(frozen=True, kw_only=True, slots=True)
class Stillness:
    """When an arm counts as settled: this slow in `samples` measurements in a row."""

    tool_speed_mps: float = 0.001
    joint_speed_rps: float = 0.001
    samples: int = 5


def wait_settled(arm: Arm, *, timeout_s: float, still: Stillness | None = None) -> ArmState:
    """Wait until the move under way has ended and the arm stands still; return its state then.

    timeout_s: for the whole rest of the move, so travel counts; see `drivers.waypoints.travel_s`.

    Raises:
        SettleTimeoutError: it still moves after `timeout_s`.
        ArmError: the move ended in another way; the type says how.
    """
    still = still or Stillness()
    until_s = time.perf_counter() + timeout_s
    last_stamp_ns, quiet = -1, 0
    while time.perf_counter() < until_s:
        state = arm.state()
        raise_unless_movable(state, also=(ArmMode.MOVING,))
        if state.pose.stamp_ns != last_stamp_ns:
            last_stamp_ns = state.pose.stamp_ns
            quiet = quiet + 1 if _is_still(state, still) else 0
        if state.mode is ArmMode.READY and quiet >= still.samples:
            return state
        time.sleep(0.002)
    raise SettleTimeoutError(
        f"the arm did not come to rest within {timeout_s:.1f} s; stop it or allow more time"
    )


def raise_unless_movable(state: ArmState, also: tuple[ArmMode, ...] = ()) -> None:
    """Raise the error that belongs to the mode, unless it is READY or one of `also`."""
    if state.mode is not ArmMode.READY and state.mode not in also:
        raise _ERRORS[state.mode](state.detail or state.mode.value)


def _check_positive(**values: float) -> None:
    for name, value in values.items():
        if not (math.isfinite(value) and value > 0):
            raise MoveRefusedError(f"{name} is {value}; it must be finite and above 0")


def _is_still(state: ArmState, still: Stillness) -> bool:
    turning_rps = float(np.abs(state.joint_speeds_rps).max())
    return state.tool_speed_mps < still.tool_speed_mps and turning_rps < still.joint_speed_rps
