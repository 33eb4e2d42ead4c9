"""The process that owns ur-rtde: `python -m drivers.ur5.child FD`, FD being one end of a pipe.

ur-rtde can hold the interpreter for seconds (constructors), reconnect and repeat a command after
a lost link, and abort the process when a controller goes away. So it lives here, alone, and this
process never tries to save itself: when the link is lost it ends at once, without destructors,
and the parent starts another.

Two threads: the main thread owns the control interface and does what the parent asks; the watch
thread owns the receive interface, sends every package to the parent and ends the process.
"""

import os
import signal
import socket
import struct
import sys
import threading
import time
from multiprocessing.connection import Connection
from typing import TYPE_CHECKING, NoReturn

from drivers.ur5.dashboard import Dashboard
from drivers.ur5.messages import (
    Answer,
    Beat,
    Command,
    Farewell,
    Leave,
    MoveJoints,
    MoveLinear,
    MoveStatus,
    Prepare,
    Reply,
    Request,
    SafetyMode,
    Sample,
    Ur5Config,
)

if TYPE_CHECKING:
    from rtde_control import RTDEControlInterface
    from rtde_receive import RTDEReceiveInterface

_FREQUENCY_HZ = 125.0
_UPKEEP_S = 0.01
_WATCH_S = 0.002
_BEAT_S = 0.05
_BRAKE_S = 2.0
_VARIABLES = [
    "timestamp",
    "actual_q",
    "actual_qd",
    "actual_TCP_pose",
    "actual_TCP_speed",
    "robot_mode",
    "safety_mode",
]


class Parent:
    """The pipe to the parent, shared by both threads."""

    def __init__(self, pipe: Connection) -> None:
        self._pipe = pipe
        self._lock = threading.Lock()

    def send(self, answer: Answer) -> None:
        """Send; without a parent there is nothing left to do."""
        try:
            with self._lock:
                self._pipe.send(answer)
        except OSError:
            os._exit(0)

    def receive(self, timeout_s: float) -> Command | None:
        """Return the next command, None when there is none in time.

        Raises:
            EOFError: the parent is gone.
        """
        command: Command | None = self._pipe.recv() if self._pipe.poll(timeout_s) else None
        return command

    def end(self, error: str, text: str) -> NoReturn:
        """Say why and end the process here and now."""
        self.send(Farewell(error, text))
        os._exit(1)


class MoveRecord:
    """What the main thread lets the watch thread know.

    now: number, status and detail of the newest move. tcp_is_flange: our script runs.
    """

    def __init__(self) -> None:
        self.now: tuple[int, MoveStatus, str] = (0, MoveStatus.NONE, "")
        self.tcp_is_flange = False

    @property
    def moving(self) -> bool:
        """Say whether a move is under way."""
        return self.now[1] is MoveStatus.MOVING

    def end(self, status: MoveStatus, detail: str = "") -> None:
        """Note that the move under way has ended."""
        self.now = (self.now[0], status, detail)


class Watch:
    """Sends every package of the controller to the parent."""

    def __init__(self, receive: "RTDEReceiveInterface", parent: Parent, record: MoveRecord) -> None:
        self._receive = receive
        self._parent = parent
        self._record = record
        self.newest = self._sample()

    def run(self) -> NoReturn:
        """Watch until the link is lost."""
        spoken_s = 0.0
        while True:
            if not self._receive.isConnected():
                self._parent.end("LinkLostError", "the RTDE connection broke")
            now_s = time.monotonic()
            if self._receive.getTimestamp() != self.newest.stamp_s:
                self.newest = self._sample()
                self._parent.send(self.newest)
                spoken_s = now_s
            elif now_s - spoken_s > _BEAT_S:
                self._parent.send(Beat())
                spoken_s = now_s
            time.sleep(_WATCH_S)

    def _sample(self) -> Sample:
        """Read one package: the getters lock one by one, so an unchanged stamp must frame them."""
        receive = self._receive
        while True:
            stamp_s = receive.getTimestamp()
            move, status, detail = self._record.now
            sample = Sample(
                stamp_s=stamp_s,
                arrived_ns=time.monotonic_ns(),
                tcp_pose=tuple(receive.getActualTCPPose()),
                tcp_is_flange=self._record.tcp_is_flange,
                joints_rad=tuple(receive.getActualQ()),
                joint_speeds_rps=tuple(receive.getActualQd()),
                tool_speed=tuple(receive.getActualTCPSpeed()),
                robot_mode=receive.getRobotMode(),
                safety_mode=receive.getSafetyMode(),
                move=move,
                status=status,
                detail=detail,
            )
            if receive.getTimestamp() == stamp_s:
                return sample


class Mover:
    """Owns the control interface: has the control script run, starts moves, follows them."""

    def __init__(
        self, control: "RTDEControlInterface", config: Ur5Config, watch: Watch, record: MoveRecord
    ) -> None:
        self._control = control
        self._config = config
        self._watch = watch
        self._record = record
        self._dashboard = Dashboard(config.host)
        self._uploaded = False
        self._operation = 0
        self._linear = True
        self._braking = False

    def do(self, number: int, request: Request) -> str:
        """Do what the parent asks; return why not, or nothing."""
        if isinstance(request, Prepare):
            return self._prepare()
        if isinstance(request, MoveLinear | MoveJoints):
            return self._move(number, request)
        self.stop()
        return ""

    def upkeep(self) -> None:
        """Feed the watchdog and notice how a move ends."""
        if self._runs():
            self._control.kickWatchdog()
        if self._record.moving:
            self._follow()

    def stop(self) -> None:
        """Brake and forget the move under way."""
        if self._record.moving:
            self._record.end(MoveStatus.STOPPED, "stopped on request")
        if not self._runs():
            return
        if not self._braking:
            self._operation, self._braking = self._operation_now(), True
        if self._linear:
            self._control.stopL(self._config.stop_deceleration_mps2, True)
        else:
            self._control.stopJ(self._config.stop_deceleration_rps2, True)

    def leave(self) -> None:
        """Brake and end the control script."""
        self.stop()
        if self._runs():
            self._control.stopScript()

    def _runs(self) -> bool:
        """Say whether our script runs, not merely some program."""
        self._uploaded = self._uploaded and bool(self._control.isProgramRunning())
        self._record.tcp_is_flange = self._uploaded
        return self._uploaded

    def _prepare(self) -> str:
        """Have the script run with our payload, the flange as tool centre point, the watchdog."""
        if self._runs():
            return ""
        try:
            self._control.reuploadScript()
        except RuntimeError as error:
            return f"the controller did not take the control script ({error})"
        until_s = time.monotonic() + self._config.script_timeout_s
        while not self._control.isProgramRunning():
            if time.monotonic() > until_s:
                return "the controller did not start the control script"
            time.sleep(_UPKEEP_S)
        config, self._braking = self._config, False
        self._uploaded = (
            self._control.setTcp([0.0] * 6)
            and self._control.setPayload(config.payload_kg, list(config.payload_cog_m))
            and self._control.setWatchdog(config.watchdog_hz)
        )
        return "" if self._runs() else "the control script ended while it was set up"

    def _move(self, number: int, request: MoveLinear | MoveJoints) -> str:
        if not self._runs():
            return "the control script does not run"
        if not self._has_braked():
            return "the arm did not come to rest after the last stop"
        self._operation = self._operation_now()
        self._linear = isinstance(request, MoveLinear)
        self._record.now = (number, MoveStatus.MOVING, "")
        try:
            begun = self._begin(request)
        except ValueError as error:
            self._record.end(MoveStatus.NONE)
            return f"the robot does not take such numbers ({error})"
        if begun:
            return ""
        self._record.end(MoveStatus.NONE)
        self._dashboard.ask("stop")
        return "the controller ended its program instead of beginning the move"

    def _begin(self, request: MoveLinear | MoveJoints) -> bool:
        if isinstance(request, MoveLinear):
            target, begin = list(request.pose), self._control.moveL
            return bool(begin(target, request.speed_mps, request.acceleration_mps2, True))
        target, begin = list(request.joints_rad), self._control.moveJ
        return bool(begin(target, request.speed_rps, request.acceleration_rps2, True))

    def _has_braked(self) -> bool:
        """Wait for the end of a stop: a move begun during it would end the program."""
        until_s = time.monotonic() + _BRAKE_S
        while self._braking:
            if time.monotonic() > until_s or not self._runs():
                return False
            self._control.kickWatchdog()
            self._braking = not self._has_ended()
            time.sleep(_WATCH_S)
        return True

    def _operation_now(self) -> int:
        return int(self._control.getAsyncOperationProgressEx().operationId())

    def _has_ended(self) -> bool:
        """Say whether the operation begun after `_operation` was read has ended.

        The register may still show the operation before it: its number tells.
        """
        progress = self._control.getAsyncOperationProgressEx()
        return progress.operationId() != self._operation and not progress.isAsyncOperationRunning()

    def _follow(self) -> None:
        if self._watch.newest.safety_mode not in (SafetyMode.NORMAL, SafetyMode.REDUCED):
            self._interrupt("safety stop")
        elif not self._runs():
            self._interrupt("the program on the controller was ended or paused")
        elif self._has_ended():
            self._record.end(MoveStatus.FINISHED)

    def _interrupt(self, detail: str) -> None:
        """Note the end of a move and have the controller forget it: `play` must not resume it."""
        self._record.end(MoveStatus.INTERRUPTED, detail)
        self._dashboard.ask("stop")


def probe(host: str, timeout_s: float = 1.0) -> tuple[str, str] | None:
    """Ask for signs of life with a deadline, which the vendor library does not have.

    Returns:
        None, or the name of the error and what is wrong.
    """
    try:
        for port in (29999, 30003, 30004):
            with socket.create_connection((host, port), timeout_s) as link:
                link.settimeout(timeout_s)
                if port == 30004:
                    link.sendall(struct.pack(">HBH", 5, ord("V"), 2))
                if port != 30003 and not link.recv(1):
                    return ("LinkLostError", f"{host} closed port {port}")
    except TimeoutError:
        return ("ControllerFrozenError", f"{host} does not answer on port {port}")
    except OSError as error:
        return ("NotConnectedError", f"no UR controller at {host}, port {port}: {error.strerror}")
    return None


def main(pipe: Connection) -> NoReturn:
    """Serve the parent until it goes away."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    config: Ur5Config = pipe.recv()
    parent, record = Parent(pipe), MoveRecord()
    problem = probe(config.host)
    if problem:
        parent.end(*problem)
    try:
        receive, control = _connect(config.host)
    except RuntimeError as error:
        parent.end("NotConnectedError", f"{config.host}: {error}")
    try:
        watch = Watch(receive, parent, record)
        threading.Thread(target=watch.run, daemon=True).start()
        mover = Mover(control, config, watch, record)
        _serve(parent, mover)
    except (OSError, RuntimeError) as error:
        parent.end("LinkLostError", f"{config.host}: {error}")
    os._exit(0)


def _connect(host: str) -> "tuple[RTDEReceiveInterface, RTDEControlInterface]":
    """Return receive and control interface; nothing is uploaded and no program is touched.

    Both constructors hold the interpreter. Whether the robot is in remote control is asked
    elsewhere: the vendor's check would keep us from reading the state of one that is not.
    """
    from rtde_control import RTDEControlInterface
    from rtde_receive import RTDEReceiveInterface

    receive = RTDEReceiveInterface(host, _FREQUENCY_HZ, _VARIABLES)
    flags = RTDEControlInterface.FLAG_NO_WAIT
    flags |= RTDEControlInterface.FLAG_DISABLE_REMOTE_CONTROL_CHECK
    return receive, RTDEControlInterface(host, _FREQUENCY_HZ, flags)


def _serve(parent: Parent, mover: Mover) -> None:
    while True:
        try:
            command = parent.receive(_UPKEEP_S)
        except EOFError:
            mover.leave()
            return
        if command is not None:
            if isinstance(command.request, Leave):
                mover.leave()
                parent.send(Reply(command.number))
                return
            parent.send(Reply(command.number, mover.do(command.number, command.request)))
        mover.upkeep()


if __name__ == "__main__":
    main(Connection(int(sys.argv[1])))
