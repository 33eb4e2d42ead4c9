"""The UR5 as an Arm: typed reasons for every refusal, and two ways to stop it."""

import logging
import threading
import time
from collections.abc import Callable
from types import TracebackType
from typing import Self

import numpy as np

from drivers import kinematics
from drivers.errors import (
    ArmBusyError,
    ArmError,
    ArmLinkError,
    ArmTakenError,
    ControllerFrozenError,
    DriverProcessError,
    MoveInterruptedError,
    MoveRefusedError,
    NotConnectedError,
    NotInRemoteControlError,
    NotPoweredError,
    ProtectiveStopError,
)
from drivers.protocols import ArmMode, ArmState, Move, ToolPose, raise_unless_movable
from drivers.ur5.clock import ClockOffset
from drivers.ur5.dashboard import Dashboard
from drivers.ur5.link import ChildLink
from drivers.ur5.messages import MoveStatus, Prepare, Sample, Stop, Ur5Config
from drivers.ur5.reasons import anothers_program, power_hold, safety_hold
from drivers.ur5.requests import request_for

log = logging.getLogger(__name__)

_FRESH_NS = 50_000_000
_UNLOCK_S = 2.0
_LAG_S = 0.03
"""The state may reach us this much later than its consequences."""
_WATCHDOG_LAG_S = 0.3
"""How much later than due the watchdog may have ended a program of ours that nobody feeds."""


class Ur5Arm:
    """A UR5 (CB3 or e-Series) behind ur-rtde; see `drivers.protocols.Arm`.

    Poses are the controller's own while our control script runs, which makes the flange the
    tool centre point; before the first move and after a stop, when another tool centre point
    may be active, they are nominal kinematics of the measured joints.
    """

    def __init__(self, config: Ur5Config) -> None:
        self._config = config
        self._dashboard = Dashboard(config.host)
        self._link: ChildLink | None = None
        self._clock = ClockOffset()
        self._arrived = threading.Condition()
        self._newest: tuple[Sample, int] | None = None
        self._sending = threading.Lock()
        self._stops = 0
        self._move = 0
        self._stopped_move = -1
        self._latch: ArmError | None = None

    def __enter__(self) -> Self:
        """Connect; nothing is uploaded to the controller and nothing moves.

        Raises:
            ArmTakenError: another client has the controller; it has noticed nothing.
            ArmLinkError: no controller there, or it does not answer.
        """
        link = ChildLink(self._config, self._on_sample, self._on_down)
        link.open()
        self._link = link
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        """Stop, end the control script, disconnect."""
        link, self._link = self._link, None
        if link is not None:
            link.close()
            self._newest, self._move, self._latch = None, 0, None

    def state(self) -> ArmState:
        """Return the newest measurement, waiting for one where the last is getting old.

        Raises:
            ArmLinkError: there is none younger than `stale_after_s`.
        """
        sample, stamp_ns = self._fresh()
        mode, detail = self._mode(sample)
        joints = np.asarray(sample.joints_rad)
        flange = (
            kinematics.transform_from_pose(sample.tcp_pose)
            if sample.tcp_is_flange
            else kinematics.forward(joints)
        )
        return ArmState(
            pose=ToolPose(stamp_ns=stamp_ns, base_from_tool0=flange),
            joints_rad=joints,
            joint_speeds_rps=np.asarray(sample.joint_speeds_rps),
            tool_speed_mps=float(np.linalg.norm(sample.tool_speed[:3])),
            mode=mode,
            detail=detail,
        )

    def check(self) -> None:
        """Raise what keeps the arm from moving, local control too; see `Arm.check`.

        Raises:
            ArmTakenError: another client has the controller, or another's program is on it.
        """
        sample, _ = self._fresh()
        raise_unless_movable(self.state(), also=(ArmMode.MOVING, ArmMode.INTERRUPTED))
        self._require_alone(_LAG_S)
        self._require_remote_control(sample)

    def start_move(self, move: Move) -> None:
        """Begin a move after checking that the arm can follow it; see `Arm.start_move`."""
        stops = self._stops
        state = self.state()
        if state.mode is ArmMode.MOVING:
            raise ArmBusyError("a move is under way: wait for its end or stop it")
        raise_unless_movable(state, also=(ArmMode.INTERRUPTED,))
        request = request_for(move, state)
        self._prepare(self._fresh()[0])
        with self._sending:
            if self._stops != stops:
                raise MoveInterruptedError("stopped on request before the move began")
            if self._newest is not None and self._moving(self._newest[0]):
                raise ArmBusyError("another thread began a move: wait for its end or stop it")
            pending = self._connected().post(request)
            self._move = pending.number
        reply = pending.wait(self._config.command_timeout_s)
        if reply is None:
            raise self._give_up("did not answer a move")
        if reply.refusal:
            self._move = 0
            raise self._why_refused(reply.refusal)

    def stop(self) -> None:
        """Brake through the child; where that is not confirmed in time, end it and the program.

        A program of another's is ended over the dashboard, be the arm opened or not: whoever asks
        for a stop sees an arm that must not move, no matter who moves it.

        Raises:
            ArmLinkError: neither way is left.
        """
        link = self._link
        if link is None or not self._brake(link) or self._may_be_moved_by_another():
            self._stop_program()

    def drop(self) -> None:
        """Stop like `stop`, but leave the arm alone where another has it or moves it.

        Raises:
            ArmLinkError: no way to the controller is left.
        """
        link = self._link
        if link is None or (not link.up and isinstance(link.why_down(), ArmTakenError)):
            return
        if not self._brake(link):
            self._stop_program()

    def _brake(self, link: ChildLink) -> bool:
        """Have the child brake; say whether it has confirmed that. One that has not is ended."""
        with self._sending:
            self._stops += 1
            pending = link.post(Stop())
            self._stopped_move = self._move
        if pending.wait(self._config.stop_timeout_s) is not None:
            return True
        if link.up:
            link.kill("did not confirm a stop and was ended")
        return False

    def _may_be_moved_by_another(self) -> bool:
        """Say whether a program runs that the child does not stop, or cannot be ruled out."""
        try:
            return anothers_program(self._fresh(0)[0])
        except ArmLinkError:
            return True

    def _stop_program(self) -> None:
        try:
            self._dashboard.ask("stop")
        except OSError as error:
            raise NotConnectedError(
                f"stop not confirmed, {self._config.host} does not answer ({error}):"
                " use the emergency stop"
            ) from error

    def acknowledge(self, reason: str) -> None:
        """Unlock, power and release the arm after a stop; see `Arm.acknowledge`.

        A controller that has just come back is waited for, so that one acknowledgement is enough.

        Raises:
            ArmTakenError: another client has the controller, or another's program runs on it.
        """
        sample = self._returned()
        if not (self._latch or safety_hold(sample) or power_hold(sample)):
            return
        self._require_alone(self._unfed_s())
        log.info("%s: acknowledged: %s", self._config.host, reason)
        try:
            self._dashboard.ask("stop")
            self._release(sample)
            if power_hold(self._fresh()[0]):
                self._dashboard.ask("power on")
                self._dashboard.ask("brake release")
        except OSError as error:
            raise NotConnectedError(f"{self._config.host} does not answer: {error}") from error
        timeout_s = self._config.power_timeout_s
        if not self._wait(lambda sample: not power_hold(sample), timeout_s):
            raise NotPoweredError(f"not powered and released within {timeout_s} s: see the pendant")
        self._latch, self._move = None, 0

    def _release(self, sample: Sample) -> None:
        self._dashboard.ask("close safety popup")
        hold = safety_hold(sample)
        if hold is None:
            return
        mode, error = hold
        if mode is not ArmMode.PROTECTIVE_STOP:
            raise error
        answer = self._dashboard.ask("unlock protective stop")
        if not self._wait(lambda sample: not safety_hold(sample), _UNLOCK_S):
            raise ProtectiveStopError(f"still in protective stop: {answer}")

    # Asking the child

    def _connected(self) -> ChildLink:
        if self._link is None:
            raise NotConnectedError("the arm is not connected: use it inside its `with` block")
        return self._link

    def _prepare(self, sample: Sample) -> None:
        """Have the control script run."""
        self._require_alone(self._unfed_s())
        self._require_remote_control(sample)
        pending = self._connected().post(Prepare())
        reply = pending.wait(self._config.connect_timeout_s)
        if reply is None:
            try:
                raise self._give_up("did not get the control script to run")
            finally:
                if pending.sent:  # the script may run by now, without a watchdog
                    self._end_program()
        if reply.refusal:
            raise self._why_refused(reply.refusal)

    def _require_alone(self, patience_s: float) -> None:
        """Refuse to replace or end a program that is not ours, and does not end in time."""
        if not self._wait(lambda sample: not anothers_program(sample), patience_s):
            raise ArmTakenError(
                f"the controller at {self._config.host} is taken: a program that is not ours runs"
                " or is paused there; wait for its end, or `stop` it, or end it at the pendant"
            )

    def _unfed_s(self) -> float:
        """Return how long a program of ours may outlive the process that has fed it."""
        return 1 / self._config.watchdog_hz + _WATCHDOG_LAG_S

    def _require_remote_control(self, sample: Sample) -> None:
        """Refuse local control while our script does not run: it could not be uploaded.

        Controllers before 5.6 do not know the question.
        """
        if sample.tcp_is_flange:
            return
        try:
            answer = self._dashboard.ask("is in remote control")
        except OSError as error:
            raise NotConnectedError(f"{self._config.host} does not answer: {error}") from error
        if answer == "false":
            raise NotInRemoteControlError(
                "local control, commands from the pendant only: switch the controller to remote"
                " control"
            )

    def _why_refused(self, refusal: str) -> ArmError:
        time.sleep(_LAG_S)
        try:
            raise_unless_movable(self.state(), also=(ArmMode.INTERRUPTED,))
            self._require_alone(_LAG_S)
        except ArmError as error:
            return error
        return MoveRefusedError(f"{refusal}; see the log of the controller")

    def _give_up(self, what: str) -> ArmError:
        """Replace a child that does not answer; the program on the controller is ended."""
        link = self._connected()
        if link.up:
            link.kill(f"{what} and was ended")
            return DriverProcessError(f"the arm's driver process {what} and was ended")
        return link.why_down()

    # What the child says, in the link's thread

    def _on_sample(self, sample: Sample) -> None:
        cause = self._cause(sample) or self._ended_at_rest(sample)
        if cause is not None and self._latch is None:
            self._latch = cause
        stamp_ns = self._clock.host_ns(sample.stamp_s, sample.arrived_ns)
        with self._arrived:
            self._newest = (sample, stamp_ns)
            self._arrived.notify_all()

    def _cause(self, sample: Sample) -> ArmError | None:
        """Return what this sample says must be acknowledged before the next move."""
        hold = safety_hold(sample)
        if hold is None and self._under_way(sample):
            hold = power_hold(sample)
        if hold is not None:
            return hold[1]
        if sample.move == self._move and sample.status is MoveStatus.INTERRUPTED:
            return MoveInterruptedError(sample.detail)
        return None

    def _ended_at_rest(self, sample: Sample) -> ArmError | None:
        """Return that our script has ended, or was paused, while no move was under way.

        Somebody did that who may be on the way to the tree: the next move must not undo it.
        """
        before = self._newest
        ran = before is not None and before[0].tcp_is_flange
        if not ran or sample.tcp_is_flange or self._under_way(sample):
            return None
        return MoveInterruptedError("the program on the controller was ended or paused")

    def _on_down(self, error: ArmLinkError) -> None:
        log.warning("%s: %s", self._config.host, error)
        with self._arrived:
            newest, self._newest = self._newest, None
            self._arrived.notify_all()
        if newest is not None and self._under_way(newest[0]):
            self._latch = self._latch or error
            self._end_program()
        self._move = 0
        self._clock = ClockOffset()

    def _end_program(self) -> None:
        try:
            self._dashboard.ask("stop")
        except OSError as error:
            log.warning("%s: dashboard stop: %s; left to the watchdog", self._config.host, error)

    def _under_way(self, sample: Sample) -> bool:
        """Say whether the newest move is not known to have ended."""
        return self._move > sample.move or (
            self._move == sample.move and sample.status is MoveStatus.MOVING
        )

    def _moving(self, sample: Sample) -> bool:
        """Say whether a move is under way that nobody has stopped."""
        return self._under_way(sample) and self._stopped_move != self._move

    # What it means

    def _fresh(self, young_ns: int = _FRESH_NS) -> tuple[Sample, int]:
        """Return the newest sample if it is young enough, else the next one."""
        link = self._connected()
        with self._arrived:
            newest = self._newest
            if newest and time.monotonic_ns() - newest[0].arrived_ns < young_ns:
                return newest
            if link.up:
                self._arrived.wait_for(
                    lambda: self._newest is not newest, self._config.stale_after_s
                )
            if self._newest is not None and self._newest is not newest:
                return self._newest
        if not link.up:
            raise link.why_down()
        raise ControllerFrozenError(
            f"{self._config.host} has sent nothing for {self._config.stale_after_s} s"
        )

    def _returned(self) -> Sample:
        """Return a fresh sample, waiting a while for a lost link to be there again."""
        until_s = time.perf_counter() + self._config.return_timeout_s
        while True:
            try:
                return self._fresh()[0]
            except ArmLinkError:
                if self._link is None or time.perf_counter() > until_s:
                    raise
                time.sleep(_LAG_S)

    def _wait(self, wanted: Callable[[Sample], bool], timeout_s: float) -> bool:
        until_s = time.perf_counter() + timeout_s
        while not wanted(self._fresh()[0]):
            if time.perf_counter() > until_s:
                return False
            time.sleep(0.01)
        return True

    def _mode(self, sample: Sample) -> tuple[ArmMode, str]:
        hold = safety_hold(sample) or power_hold(sample)
        if hold:
            return hold[0], str(hold[1])
        if self._latch:
            return ArmMode.NOT_ACKNOWLEDGED, f"not acknowledged: {self._latch}"
        if self._moving(sample):
            return ArmMode.MOVING, ""
        if self._under_way(sample) or (self._move and sample.status is MoveStatus.STOPPED):
            return ArmMode.INTERRUPTED, "stopped on request"
        return ArmMode.READY, ""
