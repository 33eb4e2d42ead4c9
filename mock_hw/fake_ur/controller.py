"""The state of the fake controller and what one control cycle does to it."""

import logging
import math
from collections.abc import Callable, Sequence
from enum import IntEnum
from typing import Protocol

import numpy as np

from canopy_skel.geometry import FloatArray
from drivers import kinematics
from mock_hw.fake_ur.motion import JOINT_SPEED_LIMIT_RPS, JointWay, LineWay, Motion, PathError, Way

log = logging.getLogger(__name__)

HOME_RAD = (0.0, -math.pi / 2, math.pi / 2, -math.pi / 2, -math.pi / 2, 0.0)
REGISTERS = 48
_AT_REST = np.zeros(6)
_QUICK_STOP = {JointWay: 12.0, LineWay: 6.0}
_UNLOCK_DELAY_S = 5.0
_BOOT_S = 1.0


class RobotMode(IntEnum):
    """Values of the RTDE variable robot_mode."""

    POWER_OFF = 3
    BOOTING = 4
    IDLE = 5
    RUNNING = 7


class SafetyMode(IntEnum):
    """Values of the RTDE variable safety_mode."""

    NORMAL = 1
    REDUCED = 2
    PROTECTIVE_STOP = 3
    RECOVERY = 4
    SAFEGUARD_STOP = 5
    SYSTEM_EMERGENCY_STOP = 6
    ROBOT_EMERGENCY_STOP = 7
    VIOLATION = 8
    FAULT = 9


class RuntimeState(IntEnum):
    """Values of the RTDE variable runtime_state."""

    STOPPING = 0
    STOPPED = 1
    PLAYING = 2
    PAUSING = 3
    PAUSED = 4
    RESUMING = 5


class Program(Protocol):
    """What the controller runs: stepped once per control cycle until it says it has ended."""

    def step(self) -> bool:
        """Do the work of one cycle; return whether the program goes on."""
        ...


class RefusedError(Exception):
    """The controller does not do what it was asked; the message is its answer."""


class Controller:
    """One arm, one program, one set of registers; knows no socket and no wall clock.

    Everything the arm or the controller waits for (motion, unlock delay, power-on) runs
    `time_scale` times faster; cycles and stamps keep the real rate.
    """

    def __init__(self, version: tuple[int, int, int, int], time_scale: float) -> None:
        self.version = version
        self.period_s = 1 / 125 if version[0] <= 3 else 1 / 500
        self.time_scale = time_scale
        self.cycle = 0
        self.robot_mode = RobotMode.RUNNING
        self.safety_mode = SafetyMode.NORMAL
        self.runtime_state = RuntimeState.STOPPED
        self.remote_control = True
        self.refuses_scripts = False
        self.popup: str | None = None
        self.program: Program | None = None
        self.motion: Motion | None = None
        self.joints = np.array(HOME_RAD)
        self.joint_speeds = _AT_REST
        self.tcp_speed: tuple[float, ...] = (0.0,) * 6
        self.payload_kg = 0.0
        self.payload_cog_m: tuple[float, ...] = (0.0, 0.0, 0.0)
        self.speed_slider = 1.0
        self.digital_inputs = 0
        self.digital_outputs = 0
        self.analog_outputs = [0.0, 0.0]
        self.input_ints = [0] * REGISTERS
        self.input_doubles = [0.0] * REGISTERS
        self.output_ints = [0] * REGISTERS
        self.output_doubles = [0.0] * REGISTERS
        self.watchdog: Watchdog | None = None
        self.moving_s = 0.0
        self._scaled_s = 0.0
        self._stopped_at_s = 0.0
        self._later: list[tuple[float, Callable[[], None]]] = []
        self.set_tcp((0.0,) * 6)

    # What the arm is

    @property
    def stamp_s(self) -> float:
        """Return the controller clock: seconds of real time since it was switched on."""
        return self.cycle * self.period_s

    @property
    def moving(self) -> bool:
        """Say whether a motion is under way."""
        return self.motion is not None and not self.motion.done

    @property
    def steady(self) -> bool:
        """Say whether the arm stands still."""
        return self.joint_speeds is _AT_REST

    def base_from_tcp(self) -> FloatArray:
        """Return the (4, 4) pose of the tool centre point."""
        return self._base_from_tcp

    def _tcp(self) -> FloatArray:
        pose: FloatArray = kinematics.forward(self.joints) @ self.tool0_from_tcp
        return pose

    def joints_for(
        self, pose: Sequence[float], near: Sequence[float] | FloatArray | None = None
    ) -> FloatArray | None:
        """Return joints (6,) that bring the tool centre point to a UR pose; None: out of reach."""
        base_from_tool0 = kinematics.transform_from_pose(pose) @ np.linalg.inv(self.tool0_from_tcp)
        return kinematics.inverse(base_from_tool0, self.joints if near is None else near)

    def set_tcp(self, pose: Sequence[float]) -> None:
        """Set the tool centre point relative to the flange, as a UR pose."""
        self.tool0_from_tcp = kinematics.transform_from_pose(pose)
        self._base_from_tcp = self._tcp()
        self.tcp_pose = kinematics.pose_from_transform(self._base_from_tcp)

    # What a program may do

    def start_motion(self, way: Way, speed: float, acceleration: float) -> None:
        """Begin a motion from rest."""
        self.motion = Motion(way, max(speed, 1e-6), max(acceleration, 1e-6))

    def brake(self, deceleration: float) -> None:
        """Bring a motion under way to rest for good."""
        if self.motion is not None:
            self.motion.brake(deceleration)

    # What the outside may ask for

    def start_program(self, program: Program) -> None:
        """Run a program in place of the present one.

        Raises:
            RefusedError: the arm is not powered, or safety or the control mode forbids it.
        """
        if self.refuses_scripts:
            raise RefusedError("script refused")
        if self.robot_mode != RobotMode.RUNNING:
            raise RefusedError(f"robot mode is {self.robot_mode.name}")
        if self.safety_mode not in (SafetyMode.NORMAL, SafetyMode.REDUCED):
            raise RefusedError(f"safety mode is {self.safety_mode.name}")
        if not self.remote_control:
            raise RefusedError("the robot is in local control")
        self.stop_program()
        self.program = program
        self.runtime_state = RuntimeState.PLAYING

    def stop_program(self) -> None:
        """End the program; the arm brakes and what it had still to do is forgotten."""
        self.program = None
        self.watchdog = None
        self.runtime_state = RuntimeState.STOPPED
        if self.motion is not None:
            self.motion.brake(_QUICK_STOP[type(self.motion.way)])

    def pause_program(self) -> None:
        """Hold the program; `play` takes it up where it stood, motion included."""
        if self.runtime_state != RuntimeState.PLAYING:
            raise RefusedError("Failed to execute: pause")
        self.runtime_state = RuntimeState.PAUSED
        if self.motion is not None:
            self.motion.holding = _QUICK_STOP[type(self.motion.way)]

    def play_program(self) -> None:
        """Go on with a paused program."""
        stopped = self.safety_mode not in (SafetyMode.NORMAL, SafetyMode.REDUCED)
        if self.runtime_state != RuntimeState.PAUSED or stopped:
            raise RefusedError("Failed to execute: play")
        self.runtime_state = RuntimeState.PLAYING
        if self.motion is not None:
            self.motion.holding = None

    def protective_stop(self, reason: str) -> None:
        """Stop as after a collision: the program is paused until somebody unlocks and plays."""
        log.warning("protective stop: %s", reason)
        self._safety_stop(SafetyMode.PROTECTIVE_STOP, reason)

    def safeguard_stop(self, active: bool) -> None:
        """Open or close the safeguard; closing it does not start the program again."""
        if active:
            self._safety_stop(SafetyMode.SAFEGUARD_STOP, "safeguard stop")
        elif self.safety_mode == SafetyMode.SAFEGUARD_STOP:
            self.safety_mode = SafetyMode.NORMAL

    def _safety_stop(self, mode: SafetyMode, reason: str) -> None:
        if self.safety_mode in (SafetyMode.NORMAL, SafetyMode.REDUCED):
            self.safety_mode = mode
            self.popup = reason
            self._stopped_at_s = self._scaled_s
        if self.runtime_state == RuntimeState.PLAYING:
            self.pause_program()

    def unlock_protective_stop(self) -> None:
        """Release a protective stop, five seconds after it happened at the earliest."""
        if self.safety_mode != SafetyMode.PROTECTIVE_STOP:
            return
        if self._scaled_s - self._stopped_at_s < _UNLOCK_DELAY_S:
            raise RefusedError(
                "Cannot unlock protective stop until 5s after occurrence. Always inspect cause of"
                " protective stop before unlocking"
            )
        self.safety_mode = SafetyMode.NORMAL

    def emergency_stop(self, pressed: bool) -> None:
        """Press or release the emergency stop button; releasing leaves the arm without power."""
        if pressed:
            self.safety_mode = SafetyMode.ROBOT_EMERGENCY_STOP
            self.power_off()
        elif self.safety_mode == SafetyMode.ROBOT_EMERGENCY_STOP:
            self.safety_mode = SafetyMode.NORMAL

    def power_off(self) -> None:
        """Take the power from the arm; the brakes engage."""
        self._later.clear()
        self.stop_program()
        self.robot_mode = RobotMode.POWER_OFF

    def power_on(self) -> None:
        """Power the arm; it is idle, brakes engaged, a moment later."""
        if self.robot_mode == RobotMode.POWER_OFF and self.safety_mode == SafetyMode.NORMAL:
            self.robot_mode = RobotMode.BOOTING
            self._in(_BOOT_S, lambda: self._set_mode(RobotMode.IDLE))

    def release_brakes(self) -> None:
        """Release the brakes, powering the arm first where needed."""
        self.power_on()
        if self.robot_mode in (RobotMode.BOOTING, RobotMode.IDLE):
            self._in(2 * _BOOT_S, lambda: self._set_mode(RobotMode.RUNNING))

    def place_at_home(self) -> None:
        """Put the arm into its first posture, without moving there."""
        self.motion = None
        self.joints = np.array(HOME_RAD)
        self.set_tcp((0.0,) * 6)

    def restore(self) -> None:
        """Bring arm and safety back to normal at once; the pose stays, no program runs."""
        self._later.clear()
        self.stop_program()
        self.motion = None
        self.robot_mode = RobotMode.RUNNING
        self.safety_mode = SafetyMode.NORMAL
        self.remote_control = True
        self.refuses_scripts = False
        self.popup = None

    def _set_mode(self, mode: RobotMode) -> None:
        self.robot_mode = mode

    def _in(self, delay_s: float, action: Callable[[], None]) -> None:
        self._later.append((self._scaled_s + delay_s, action))

    # One control cycle

    def tick(self, cycles: int = 1) -> None:
        """Let `cycles` control periods pass (more than one where the host came late)."""
        self.cycle += cycles
        elapsed_s = cycles * self.period_s * self.time_scale
        self._scaled_s += elapsed_s
        for due_s, action in [entry for entry in self._later if entry[0] <= self._scaled_s]:
            self._later.remove((due_s, action))
            action()
        if self.watchdog is not None and self.watchdog.expired(self.stamp_s):
            log.warning("RTDE watchdog expired: program stopped")
            self.stop_program()
        if self.runtime_state == RuntimeState.PLAYING and self.program is not None:
            program = self.program
            if not program.step() and self.program is program:
                self.stop_program()
        self._move(elapsed_s * self.speed_slider)
        if not self.steady:
            self.moving_s += cycles * self.period_s

    def _move(self, elapsed_s: float) -> None:
        if self.motion is None or self.motion.done or elapsed_s <= 0.0:
            self.joint_speeds, self.tcp_speed = _AT_REST, (0.0,) * 6
            return
        self.motion.advance(elapsed_s)
        try:
            joints = self.motion.way.joints_at(self.motion.travelled, self.joints)
            speeds = (joints - self.joints) / elapsed_s
            _check(joints, speeds)
        except PathError as error:
            self.motion = None
            self.protective_stop(str(error))
            return
        self.joints = joints
        self.joint_speeds = speeds if self.motion.rate > 0.0 else _AT_REST
        before, self._base_from_tcp = self._base_from_tcp, self._tcp()
        self.tcp_pose = kinematics.pose_from_transform(self._base_from_tcp)
        rest = self.steady
        self.tcp_speed = (0.0,) * 6 if rest else _speed(before, self._base_from_tcp, elapsed_s)


def _speed(before: FloatArray, after: FloatArray, elapsed_s: float) -> tuple[float, ...]:
    """Return linear and angular velocity between two poses, both in base."""
    turn = kinematics.rotation_vector(after[:3, :3] @ before[:3, :3].T)
    shift = after[:3, 3] - before[:3, 3]
    return tuple(step / elapsed_s for step in (*shift.tolist(), *turn.tolist()))


class Watchdog:
    """Stops the program when nobody writes the command register often enough (real time)."""

    def __init__(self, register: int, minimum_hz: float, now_s: float) -> None:
        self.register = register
        self._period_s = 1 / minimum_hz
        self._fed_s = now_s

    def feed(self, now_s: float) -> None:
        """Note that the register was written."""
        self._fed_s = now_s

    def expired(self, now_s: float) -> bool:
        """Say whether the last write is too long ago."""
        return now_s - self._fed_s > self._period_s


def _check(joints: FloatArray, speeds: FloatArray) -> None:
    if not kinematics.within_limits(joints):
        raise PathError("joint position limit exceeded")
    if np.abs(speeds).max() > 1.05 * JOINT_SPEED_LIMIT_RPS:
        raise PathError("joint speed limit exceeded (close to a singularity)")
