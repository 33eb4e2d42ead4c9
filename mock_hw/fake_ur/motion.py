"""How the fake arm moves: trapezoidal speed along straight lines in joint or Cartesian space."""

import math
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from canopy_skel.geometry import FloatArray, transform_from
from drivers import kinematics

JOINT_SPEED_LIMIT_RPS = math.pi
"""A UR5 joint turns at most 180° per second (data sheet)."""

_STEP_S = 0.008
_ARRIVED = 1e-9


class PathError(Exception):
    """The arm cannot follow its path here; the message is what the controller would log."""


class Way(Protocol):
    """A way through space of some length in metres or radians."""

    @property
    def length(self) -> float:
        """Return the length in the unit of the commanded speed."""
        ...

    def joints_at(self, travelled: float, near_joints: FloatArray) -> FloatArray:
        """Return the joints (6,) after `travelled`; raise PathError where there are none."""
        ...


class JointWay:
    """All joints turn in proportion; the length is that of the joint with the longest way."""

    def __init__(self, start_rad: FloatArray, end_rad: FloatArray) -> None:
        self._start_rad = start_rad
        self._turn_rad = end_rad - start_rad
        self.length = float(np.abs(self._turn_rad).max())

    def joints_at(self, travelled: float, near_joints: FloatArray) -> FloatArray:
        """Return the joints (6,) after the leading joint has turned by `travelled` radians."""
        fraction = travelled / self.length if self.length > 0 else 1.0
        return self._start_rad + fraction * self._turn_rad


class LineWay:
    """The tool centre point runs straight and turns about one axis at a constant rate."""

    def __init__(
        self, base_from_start: FloatArray, base_from_end: FloatArray, tool0_from_tcp: FloatArray
    ) -> None:
        self._start = base_from_start
        self._shift_m = base_from_end[:3, 3] - base_from_start[:3, 3]
        self._turn_rad = kinematics.rotation_vector(
            kinematics.relative_turn(base_from_start, base_from_end)
        )
        self._tcp_from_tool0 = np.linalg.inv(tool0_from_tcp)
        length_m = float(np.linalg.norm(self._shift_m))
        self.length = length_m if length_m > 1e-9 else float(np.linalg.norm(self._turn_rad))

    def joints_at(self, travelled: float, near_joints: FloatArray) -> FloatArray:
        """Return the joints (6,) that put the tool centre point `travelled` along the line."""
        fraction = travelled / self.length if self.length > 0 else 1.0
        turn = kinematics.rotation_from_vector(fraction * self._turn_rad)
        base_from_tcp = transform_from(
            self._start[:3, :3] @ turn, self._start[:3, 3] + fraction * self._shift_m
        )
        joints = kinematics.inverse(base_from_tcp @ self._tcp_from_tool0, near_joints)
        if joints is None:
            raise PathError("Inverse kinematics found no solution on the line")
        return joints


@dataclass(slots=True)
class Motion:
    """One motion in progress: where it is on its way, how fast, and what slows it down.

    braking: deceleration of a stop that ends the motion. holding: deceleration of a pause, after
    which the rest of the way may still be travelled.
    """

    way: Way
    speed: float
    acceleration: float
    travelled: float = 0.0
    rate: float = 0.0
    braking: float | None = None
    holding: float | None = None

    @property
    def done(self) -> bool:
        """Say whether the arm has arrived, or has come to rest after braking."""
        if self.braking is not None and self.rate <= 0.0:
            return True
        return self.travelled >= self.way.length

    def brake(self, deceleration: float) -> None:
        """Come to rest along the way; a harder brake replaces a softer one."""
        self.braking = max(deceleration, self.braking or 0.0, 1e-3)

    def advance(self, duration_s: float) -> None:
        """Let time pass: speed up, cruise, slow down in time for the end, or brake."""
        steps = max(1, math.ceil(duration_s / _STEP_S))
        for _ in range(steps):
            self._step(duration_s / steps)

    def _step(self, period_s: float) -> None:
        remaining = self.way.length - self.travelled
        slowing = max(self.braking or 0.0, self.holding or 0.0)
        if slowing > 0.0:
            rate = max(0.0, self.rate - slowing * period_s)
        else:
            still_stops = _highest_rate(remaining, self.rate, self.acceleration, period_s)
            rate = min(self.rate + self.acceleration * period_s, self.speed, still_stops)
        self.travelled += 0.5 * (self.rate + rate) * period_s
        self.rate = rate
        if self.way.length - self.travelled < _ARRIVED:
            self.travelled, self.rate = self.way.length, 0.0


def _highest_rate(remaining: float, rate: float, acceleration: float, period_s: float) -> float:
    """Return the highest rate after one more period from which braking ends at the goal.

    Solves (rate + next) / 2 · period + next² / (2 · acceleration) = remaining for next.
    """
    half = acceleration * period_s / 2
    square = half * half + 2 * acceleration * remaining - 2 * half * rate
    return max(0.0, math.sqrt(max(0.0, square)) - half)
