"""Programs the fake controller runs: ur-rtde's control script, and straight lists of statements.

The control script is a register protocol: it reads a command number and its arguments from input
registers and answers through output registers. It is recognised by its main loop and then played
by a coroutine that follows the same protocol, cycle by cycle. Any other program must be made of
the few statements of `statements.py`.
"""

import re
from collections.abc import Iterable

from canopy_skel.geometry import FloatArray
from drivers import kinematics
from mock_hw.fake_ur.controller import Controller, Program, Watchdog, log
from mock_hw.fake_ur.statements import Cycles, ScriptError, Statements, move, step, stop, way_to

_CONTROL_LOOP = "RTDE Control script - Main loop"
_OFFSET = re.compile(r"reg_offset_int = # int register offset\s*(\d+)")
_PATH = re.compile(r"# inject move path[^\n]*\n(.*?)^\s*end\b", re.S | re.M)
_REALTIME = {6, 9, 10, 11, 12, 24, 25, 26, 27, 38, 58, 66, 67, 68, 69, 70, 71}
_READY, _DONE = 1, 2
_STOP_SCRIPT = 255


def load(text: str, controller: Controller) -> Program:
    """Return the runnable form of an uploaded program.

    Raises:
        RefusedError: it holds a statement that the fake controller does not know.
    """
    if _CONTROL_LOOP in text:
        return ControlScript(text, controller)
    lines = [line.strip() for line in text.splitlines()]
    body = [line for line in lines if line and line != "end" and not line.startswith(("def ", "#"))]
    return Straight(Statements(body, controller, lambda progress: None).run())


class Straight:
    """A program of statements without a loop."""

    def __init__(self, cycles: Cycles) -> None:
        self._cycles = cycles

    def step(self) -> bool:
        """Run one cycle; False when the program has ended or failed."""
        return step(self._cycles)


class ControlScript:
    """The register protocol of ur-rtde's control script, with its move and stop threads."""

    def __init__(self, text: str, controller: Controller) -> None:
        self._controller = controller
        self._text = text
        offset = _OFFSET.search(text)
        self._offset = int(offset[1]) if offset else 0
        injected = _PATH.search(text)
        lines = injected[1].splitlines() if injected else []
        body = [line.strip() for line in lines if line.strip()]
        self._path = Statements(body, controller, self._signal)
        self._main = self._run()
        self._thread: Cycles | None = None
        self._stopping = False
        self._failed = False
        self._writes = 0
        self._operation = 0

    def step(self) -> bool:
        """Run the main loop and the move or stop thread for one cycle."""
        alive = step(self._main)
        if alive and self._thread is not None:
            self._step_thread(self._thread)
        return alive and not self._failed

    def _step_thread(self, thread: Cycles) -> None:
        try:
            next(thread)
        except StopIteration:
            self._thread = None
        except ScriptError as error:
            log.warning("program stopped: %s", error)
            self._failed = True

    # Registers

    def _command(self) -> int:
        return self._controller.input_ints[self._offset]

    def _int(self, register: int) -> int:
        return self._controller.input_ints[self._offset + register]

    def _doubles(self, first: int, count: int) -> list[float]:
        start = self._offset + first
        return self._controller.input_doubles[start : start + count]

    def _answer(self, values: Iterable[float]) -> None:
        for register, value in enumerate(values):
            self._controller.output_doubles[self._offset + register] = float(value)

    def _answer_int(self, value: int) -> None:
        self._controller.output_ints[self._offset + 1] = int(value)

    def _report(self, status: int) -> None:
        self._controller.output_ints[self._offset] = status

    def _signal(self, progress: int) -> None:
        """Write the asynchronous progress register: 0 starts an operation, below 0 ends it."""
        self._writes = (self._writes + 1) % 128
        if progress == 0:
            self._operation = (self._operation + 1) % 128
        running = 0x8000 + min(progress, 0x7FFF) if progress >= 0 else 0
        word = (self._operation << 24) + (self._writes << 16) + running
        self._controller.output_ints[self._offset + 2] = word

    # The main loop

    def _run(self) -> Cycles:
        self._signal(-1)
        self._report(_READY)
        answered = False
        while (command := self._command()) != _STOP_SCRIPT:
            if command in _REALTIME:
                yield from self._process(command)
                self._report(_READY)
            elif command == 0:
                answered = False
                self._report(_READY)
            elif not answered:
                yield from self._process(command)
                self._report(_DONE)
                answered = True
            yield

    def _process(self, command: int) -> Cycles:
        if command in (1, 2, 3, 4):
            yield from self._move(command)
        elif command in (33, 34):
            yield from self._stop()
        elif command == 45:
            self._refuse_while_stopping()
            yield from self._start(self._path.run(), asynchronous=self._int(1) == 1)
        else:
            self._answer_at_once(command)

    # Motion

    def _move(self, command: int) -> Cycles:
        target = self._doubles(0, 6)
        speed, acceleration = self._doubles(6, 2)
        asynchronous = self._int(1) == 1
        verb = "movej" if command in (1, 2) else "movel"
        is_pose = command in (2, 3)
        self._refuse_while_stopping()
        self._kill_thread()
        yield from stop(self._controller, acceleration)
        way = way_to(self._controller, verb, target, is_pose=is_pose)
        yield from self._start(
            move(self._controller, way, speed, acceleration), asynchronous=asynchronous
        )

    def _stop(self) -> Cycles:
        (deceleration,) = self._doubles(0, 1)
        self._kill_thread()
        asynchronous = self._int(1) == 1
        yield from self._start(stop(self._controller, deceleration), asynchronous=asynchronous)
        self._stopping = asynchronous

    def _refuse_while_stopping(self) -> None:
        if self._stopping and self._thread is not None:
            raise ScriptError("another thread is already controlling the robot")

    def _start(self, work: Cycles, *, asynchronous: bool) -> Cycles:
        if asynchronous:
            self._kill_thread()
            self._stopping = False
            self._thread = self._as_operation(work)
        else:
            yield from work

    def _as_operation(self, work: Cycles) -> Cycles:
        self._signal(0)
        yield
        yield from work
        self._signal(-1)

    def _kill_thread(self) -> None:
        if self._thread is not None:
            self._thread = None
            self._signal(-1)

    # Commands that are answered within the cycle

    def _answer_at_once(self, command: int) -> None:
        arm = self._controller
        match command:
            case 17:
                arm.payload_kg, *cog = self._doubles(0, 4)
                arm.payload_cog_m = tuple(cog)
            case 29:
                arm.set_tcp(self._doubles(0, 6))
            case 31:
                arm.protective_stop("triggered by the program")
            case 35:
                arm.watchdog = Watchdog(self._offset, self._doubles(0, 1)[0], arm.stamp_s)
            case 36:
                self._answer_int(self._inverse(near=None) is not None)
            case 37:
                self._answer_int(kinematics.within_limits(self._doubles(0, 6)))
            case 47:
                self._answer_int(arm.steady)
            case 30 | 39 | 40 | 43 | 44 | 46 | 58 | 60 | 61:
                self._answer_geometry(command)
            case _:
                raise ScriptError(f"command {command} is not simulated")

    def _answer_geometry(self, command: int) -> None:
        arm = self._controller
        near = self._doubles(6, 6) if command in (30, 61) else None
        match command:
            case 30 | 46:
                joints = self._inverse(near)
                if joints is None:
                    raise ScriptError("Inverse kinematics could not find a solution")
                self._answer(joints)
            case 60 | 61 if "get_inverse_kin_has_solution(x" in self._text:
                self._answer_int(self._inverse(near) is not None)
            case 39:
                a, b = (kinematics.transform_from_pose(self._doubles(i, 6)) for i in (0, 6))
                self._answer_pose(a @ b)
            case 40:
                self._answer_pose(arm.tool0_from_tcp)
            case 43:
                self._answer(arm.tcp_pose)
            case 44:
                tool0_from_tcp = kinematics.transform_from_pose(self._doubles(6, 6))
                self._answer_pose(kinematics.forward(self._doubles(0, 6)) @ tool0_from_tcp)
            case 58:
                self._answer_pose(kinematics.forward(arm.joints))

    def _inverse(self, near: list[float] | None) -> FloatArray | None:
        joints = self._controller.joints_for(self._doubles(0, 6), near)
        return joints if joints is not None and kinematics.within_limits(joints) else None

    def _answer_pose(self, transform: FloatArray) -> None:
        self._answer(kinematics.pose_from_transform(transform))
