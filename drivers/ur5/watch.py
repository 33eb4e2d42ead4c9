"""The child's watch thread: every package of the controller goes to the parent."""

import os
import threading
import time
from multiprocessing.connection import Connection
from typing import TYPE_CHECKING, NoReturn

from drivers.ur5.messages import (
    ENDED,
    Answer,
    Beat,
    Command,
    Farewell,
    MoveStatus,
    RuntimeState,
    Sample,
)

if TYPE_CHECKING:
    from rtde_receive import RTDEReceiveInterface

VARIABLES = [
    "timestamp",
    "actual_q",
    "actual_qd",
    "actual_TCP_pose",
    "actual_TCP_speed",
    "robot_mode",
    "safety_mode",
    "runtime_state",
]
"""RTDE variables a sample is made of."""

_PAUSED = (RuntimeState.PAUSING, RuntimeState.PAUSED)
_PERIOD_S = 0.002
_BEAT_S = 0.05


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

    now: number, status and detail of the newest move. tcp_is_flange: our script runs. preparing:
    it is on its way there.
    """

    def __init__(self) -> None:
        self.now: tuple[int, MoveStatus, str] = (0, MoveStatus.NONE, "")
        self.tcp_is_flange = False
        self.preparing = False

    @property
    def moving(self) -> bool:
        """Say whether a move is under way."""
        return self.now[1] is MoveStatus.MOVING

    def end(self, status: MoveStatus, detail: str = "") -> None:
        """Note that the move under way has ended."""
        self.now = (self.now[0], status, detail)


class Watch:
    """Sends every package of the controller to the parent.

    ours_left: our script was seen to run or to be set up, and not yet to end: it may be paused, and
    `play` would go on with it.
    """

    def __init__(self, receive: "RTDEReceiveInterface", parent: Parent, record: MoveRecord) -> None:
        self._receive = receive
        self._parent = parent
        self._record = record
        self._played = False
        self.ours_left = False
        self.newest = self._sample(ours_before=False)

    def run(self) -> NoReturn:
        """Watch until the link is lost."""
        spoken_s = 0.0
        while True:
            if not self._receive.isConnected():
                self._parent.end(
                    "LinkLostError", "the link to the controller broke: check cable and power"
                )
            now_s = time.monotonic()
            if self._receive.getTimestamp() != self.newest.stamp_s:
                self.newest = self._sample(self.newest.program_is_ours)
                self._note_end(self.newest)
                self._parent.send(self.newest)
                spoken_s = now_s
            elif now_s - spoken_s > _BEAT_S:
                self._parent.send(Beat())
                spoken_s = now_s
            time.sleep(_PERIOD_S)

    def _note_end(self, sample: Sample) -> None:
        """Note the end of our script: the next one to run may be another's.

        The main thread may be waiting in a call of the vendor's meanwhile.
        """
        plays = sample.runtime_state == RuntimeState.PLAYING
        if self._played and not plays:
            self._record.tcp_is_flange = False
        self._played = plays and sample.tcp_is_flange
        if sample.runtime_state in ENDED:
            self.ours_left = False
        elif sample.program_is_ours:
            self.ours_left = True

    def _sample(self, ours_before: bool) -> Sample:
        """Read one package: the getters lock one by one, so an unchanged stamp must frame them."""
        receive = self._receive
        while True:
            stamp_s = receive.getTimestamp()
            move, status, detail = self._record.now
            tcp_is_flange = self._record.tcp_is_flange
            runtime_state = receive.getRuntimeState()
            still_ours = ours_before and runtime_state in _PAUSED
            sample = Sample(
                stamp_s=stamp_s,
                arrived_ns=time.monotonic_ns(),
                tcp_pose=tuple(receive.getActualTCPPose()),
                tcp_is_flange=tcp_is_flange,
                joints_rad=tuple(receive.getActualQ()),
                joint_speeds_rps=tuple(receive.getActualQd()),
                tool_speed=tuple(receive.getActualTCPSpeed()),
                robot_mode=receive.getRobotMode(),
                safety_mode=receive.getSafetyMode(),
                runtime_state=runtime_state,
                program_is_ours=tcp_is_flange or self._record.preparing or still_ours,
                move=move,
                status=status,
                detail=detail,
            )
            if receive.getTimestamp() == stamp_s:
                return sample
