"""Straight programs: moves, stops, register writes and pauses, one statement after the other."""

import re
from collections.abc import Callable, Generator, Iterable

import numpy as np

from drivers import kinematics
from mock_hw.fake_ur.controller import Controller, RefusedError, log
from mock_hw.fake_ur.motion import JointWay, LineWay, Way

Cycles = Generator[None, None, None]
"""A coroutine that yields once per control cycle."""

_NUMBER = r"-?[0-9.]+(?:[eE][+-]?[0-9]+)?"
_STATEMENT = re.compile(
    r"(?P<move>movej|movel|movep)\((?P<pose>p?)\[(?P<target>[^\]]*)\](?P<options>[^)]*)\)$"
    rf"|(?P<stop>stopj|stopl)\((?P<deceleration>{_NUMBER})\)$"
    r"|write_output_integer_register\((?P<register>[0-9 +]+),\s*(?P<value>-?\d+)\)$"
    r"|signal_async_progress\((?P<progress>\d+)\)$"
    rf"|sleep\((?P<sleep>{_NUMBER})\)$"
    r"|textmsg\(.*\)$"
)
_OPTION = re.compile(rf"([avr])\s*=\s*({_NUMBER})")


class ScriptError(Exception):
    """The program cannot go on; the message is what the controller would log."""


def step(cycles: Cycles) -> bool:
    """Run one cycle of a coroutine; False when it has ended or failed."""
    try:
        next(cycles)
    except StopIteration:
        return False
    except ScriptError as error:
        log.warning("program stopped: %s", error)
        return False
    return True


class Statements:
    """Statements run one after the other: moves, stops, register writes, pauses."""

    def __init__(
        self, lines: Iterable[str], controller: Controller, on_progress: Callable[[int], None]
    ) -> None:
        self._controller = controller
        self._on_progress = on_progress
        self._matches = [_parsed(line) for line in lines]

    def run(self) -> Cycles:
        """Run all statements."""
        for found in self._matches:
            yield from self._run_one(found)

    def _run_one(self, found: re.Match[str]) -> Cycles:
        if found["move"]:
            options = {key: float(value) for key, value in _OPTION.findall(found["options"])}
            target = [float(value) for value in found["target"].split(",")]
            way = way_to(self._controller, found["move"], target, is_pose=bool(found["pose"]))
            yield from move(self._controller, way, options["v"], options["a"])
        elif found["stop"]:
            yield from stop(self._controller, float(found["deceleration"]))
        elif found["register"]:
            register = sum(int(part) for part in found["register"].split("+"))
            self._controller.output_ints[register] = int(found["value"])
            yield
        elif found["progress"]:
            self._on_progress(int(found["progress"]))
        elif found["sleep"]:
            wait_s = float(found["sleep"]) / self._controller.time_scale
            until_s = self._controller.stamp_s + wait_s
            while self._controller.stamp_s < until_s:
                yield


def _parsed(line: str) -> re.Match[str]:
    found = _STATEMENT.match(line)
    if found is None:
        raise RefusedError(f"syntax error: {line!r} is not a statement this controller runs")
    return found


def way_to(controller: Controller, verb: str, target: list[float], *, is_pose: bool) -> Way:
    """Return the way from where the arm stands.

    Raises:
        ScriptError: the target is out of reach or outside the joint limits.
    """
    if is_pose:
        joints = controller.joints_for(target)
        if joints is None:
            raise ScriptError("Inverse kinematics could not find a solution for the target")
    else:
        joints = np.array(target)
    if not kinematics.within_limits(joints):
        raise ScriptError("target outside the joint limits")
    if verb == "movej":
        return JointWay(controller.joints, joints)
    end = kinematics.forward(joints) @ controller.tool0_from_tcp
    return LineWay(controller.base_from_tcp(), end, controller.tool0_from_tcp)


def move(controller: Controller, way: Way, speed: float, acceleration: float) -> Cycles:
    """Move along a way and wait for the end of it."""
    controller.start_motion(way, speed, acceleration)
    while controller.moving:
        yield


def stop(controller: Controller, deceleration: float) -> Cycles:
    """Bring the arm to rest and wait for it."""
    controller.brake(deceleration)
    while controller.moving:
        yield
