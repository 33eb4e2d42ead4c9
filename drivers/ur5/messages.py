"""What the arm's child process and its parent say to each other over their pipe."""

from dataclasses import dataclass
from enum import IntEnum

Vector = tuple[float, ...]


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
    """Values of the RTDE variable runtime_state: how the program on the controller stands."""

    STOPPING = 0
    STOPPED = 1
    PLAYING = 2
    PAUSING = 3
    PAUSED = 4
    RESUMING = 5


ENDED = (RuntimeState.STOPPING, RuntimeState.STOPPED)
"""No program runs and none is paused, or not for long."""

ROBOT_RUNNING = 7


@dataclass(frozen=True, kw_only=True, slots=True)
class Ur5Config:
    """One arm and how it is looked after.

    host: address of the controller. payload_kg, payload_cog_m: what the flange carries.
    watchdog_hz: the controller stops by itself when it hears less often than this.
    stale_after_s: a measurement older than this is never returned. stop_timeout_s: how long a
    stop may go unanswered before the dashboard is used instead. return_timeout_s: how long
    `acknowledge` waits for a lost controller that is coming back.
    """

    host: str
    payload_kg: float = 0.0
    payload_cog_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    watchdog_hz: float = 5.0
    stale_after_s: float = 0.3
    connect_timeout_s: float = 10.0
    command_timeout_s: float = 3.0
    stop_timeout_s: float = 0.5
    script_timeout_s: float = 5.0
    power_timeout_s: float = 40.0
    return_timeout_s: float = 5.0
    stop_deceleration_mps2: float = 1.0
    stop_deceleration_rps2: float = 2.0


class MoveStatus(IntEnum):
    """How the newest move stands: STOPPED as the parent asked, INTERRUPTED by anything else."""

    NONE = 0
    MOVING = 1
    FINISHED = 2
    STOPPED = 3
    INTERRUPTED = 4


@dataclass(frozen=True, slots=True)
class Prepare:
    """Have the control script run on the controller, uploading it where needed."""


@dataclass(frozen=True, slots=True)
class MoveLinear:
    """Move straight to a UR pose (metres, rotation vector)."""

    pose: Vector
    speed_mps: float
    acceleration_mps2: float


@dataclass(frozen=True, slots=True)
class MoveJoints:
    """Turn the joints to these angles."""

    joints_rad: Vector
    speed_rps: float
    acceleration_rps2: float


@dataclass(frozen=True, slots=True)
class Stop:
    """Brake and forget the move under way."""


@dataclass(frozen=True, slots=True)
class Leave:
    """End the control script and the child."""


Request = Prepare | MoveLinear | MoveJoints | Stop | Leave


@dataclass(frozen=True, slots=True)
class Command:
    """A request with the number its reply will carry; a move keeps it as its name."""

    number: int
    request: Request


@dataclass(frozen=True, slots=True)
class Reply:
    """The answer to a command: empty `refusal` when it was done."""

    number: int
    refusal: str = ""


@dataclass(frozen=True, slots=True)
class Sample:
    """One package of the controller, and how the newest move stood when it came.

    stamp_s: controller clock. arrived_ns: host monotonic clock. tcp_pose: of the active tool
    centre point, UR form; `tcp_is_flange` while our control script sees to it that this is the
    flange. runtime_state, program_is_ours: how the program on the controller stands, and whose it
    is; a paused one is ours where ours was seen to run until then.
    """

    stamp_s: float
    arrived_ns: int
    tcp_pose: Vector
    tcp_is_flange: bool
    joints_rad: Vector
    joint_speeds_rps: Vector
    tool_speed: Vector
    robot_mode: int
    safety_mode: int
    runtime_state: int
    program_is_ours: bool
    move: int
    status: MoveStatus
    detail: str


@dataclass(frozen=True, slots=True)
class Beat:
    """The child lives, although the controller has said nothing new."""


@dataclass(frozen=True, slots=True)
class Farewell:
    """Why the child ends: `error` names a class of drivers.errors."""

    error: str
    text: str


Answer = Reply | Sample | Beat | Farewell
