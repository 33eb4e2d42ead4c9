"""The child's hand on the control interface: has the script run, starts moves, follows them."""

import math
import time
from typing import TYPE_CHECKING

from drivers.ur5.dashboard import Dashboard
from drivers.ur5.messages import (
    MoveJoints,
    MoveLinear,
    MoveStatus,
    Prepare,
    Request,
    SafetyMode,
    Ur5Config,
)
from drivers.ur5.watch import MoveRecord, Watch

if TYPE_CHECKING:
    from rtde_control import RTDEControlInterface

_MAY_MOVE = (SafetyMode.NORMAL, SafetyMode.REDUCED)
_POLL_S = 0.005
_BRAKE_S = 2.0
_CAUSE_S = 0.02
"""The two connections lag each other: a program may be seen to end before the reason for it is."""


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
        self._operation = 0
        self._linear = True
        self._braking = False
        self._not_running_since_s = math.inf

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
        """Brake and forget the move under way, on the controller too: `play` must not resume it.

        A program that is not ours is left to the parent, which knows whether somebody asked.
        """
        under_way = self._record.moving
        if under_way:
            self._record.end(MoveStatus.STOPPED, "stopped on request")
        safe = self._watch.newest.safety_mode in _MAY_MOVE
        if under_way and not (safe and self._runs()):
            self._end_ours()
            return
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
        if self._record.tcp_is_flange and not self._control.isProgramRunning():
            self._record.tcp_is_flange = False
        return self._record.tcp_is_flange

    def _prepare(self) -> str:
        """Have the script run with our payload, the flange as tool centre point, the watchdog."""
        if self._runs():
            return ""
        if self._control.isProgramRunning():
            return "a program runs that is not ours"
        self._record.preparing = True
        try:
            refusal = self._upload()
            if refusal:  # it may start late, or run on: without the watchdog nobody would end it
                self._dashboard.ask("stop")
            return refusal
        finally:
            self._record.preparing = False

    def _upload(self) -> str:
        try:
            self._control.reuploadScript()
        except RuntimeError as error:
            return f"the controller did not take the control script ({error})"
        until_s = time.monotonic() + self._config.script_timeout_s
        while not self._control.isProgramRunning():
            if time.monotonic() > until_s:
                return "the controller did not start the control script"
            time.sleep(_POLL_S)
        config, self._braking = self._config, False
        self._record.tcp_is_flange = (
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
        self._not_running_since_s = math.inf
        self._record.now = (number, MoveStatus.MOVING, "")
        try:
            begun = self._begin(request)
        except ValueError as error:
            self._record.end(MoveStatus.NONE)
            return f"the robot does not take such numbers ({error})"
        if begun:
            return ""
        self._record.end(MoveStatus.NONE)
        self._end_ours()
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
            time.sleep(_POLL_S)
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
        newest = self._watch.newest
        if newest.safety_mode not in _MAY_MOVE:
            self._interrupt("safety stop")
        elif not self._runs():
            self._not_running_since_s = min(self._not_running_since_s, newest.stamp_s)
            if newest.stamp_s - self._not_running_since_s > _CAUSE_S:
                self._interrupt("the program on the controller was ended or paused")
        elif self._has_ended():
            self._record.end(MoveStatus.FINISHED)

    def _interrupt(self, detail: str) -> None:
        """Note the end of a move and have the controller forget it: `play` must not resume it."""
        self._record.end(MoveStatus.INTERRUPTED, detail)
        self._end_ours()

    def _end_ours(self) -> None:
        """End our program unless it has ended: what runs by then is another's."""
        if self._watch.ours_left:
            self._dashboard.ask("stop")
