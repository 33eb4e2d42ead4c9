"""What the HTTP side knows of arm, camera and scans; `service.scan` and `compose` stand behind."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path
from typing import Any, Protocol

from canopy_skel.geometry import FloatArray
from canopy_skel.pipeline import MethodConfig


class ScanState(StrEnum):
    """Where a scan is. STOPPED: motion was dropped; an operator must acknowledge, then resume."""

    RUNNING = "running"
    PAUSED = "paused"
    STOPPED = "stopped"
    DONE = "done"
    CANCELLED = "cancelled"
    FAILED = "failed"


class ScanKind(StrEnum):
    """What a scan is. REPLAY: nothing moves, its views come from a recording there is already."""

    SCAN = "scan"
    REPLAY = "replay"


FINISHED = frozenset({ScanState.DONE, ScanState.CANCELLED, ScanState.FAILED})
CAUGHT_UP = "caught_up"
"""The kind of event that says: nothing more of an earlier scan will be fed to a worker."""


@dataclass(frozen=True, kw_only=True, eq=False, slots=True)
class ScanSpec:
    """What to scan and how.

    waypoints: base_from_tool0 (4, 4) of each exposure, in order. speed_mps,
    acceleration_mps2: of the flange between them. settle_timeout_s: for coming to rest, beyond
    what the move itself may take. retakes: further tries for a bad picture.
    """

    scan_id: str
    tree_id: str
    waypoints: tuple[FloatArray, ...]
    config: MethodConfig
    segmenter: str = "recorded"
    speed_mps: float = 0.25
    acceleration_mps2: float = 0.5
    settle_timeout_s: float = 20.0
    grab_timeout_s: float = 10.0
    retakes: int = 2


@dataclass(frozen=True, kw_only=True, slots=True)
class ScanStatus:
    """A scan at a moment. detail: one line on why it is in this state, empty while all is well."""

    scan_id: str
    tree_id: str
    state: ScanState
    views_done: int
    views_total: int
    detail: str = ""


def status_fields(status: ScanStatus) -> dict[str, Any]:
    """Return a status ready for JSON."""
    return {name: getattr(status, name) for name in ScanStatus.__slots__} | {
        "state": status.state.value
    }


@dataclass(frozen=True, kw_only=True, slots=True)
class WaypointVerdict:
    """Whether a waypoint can be driven to; reason is empty if so."""

    index: int
    reachable: bool
    reason: str = ""


@dataclass(frozen=True, kw_only=True, slots=True)
class RigEvent:
    """Something that happened, for operators and the journal. kind: short, e.g. "view".

    A scan that ended badly by itself is told with a `detail` that says why, which is also why the
    arm is held; one that an operator stopped is told without.
    """

    scan_id: str
    kind: str
    fields: Mapping[str, object] = field(default_factory=dict)


@dataclass(frozen=True, kw_only=True, slots=True)
class PartStatus:
    """Whether a part of the rig (arm, camera, worker, disk) can be used; detail names the mend."""

    name: str
    ready: bool
    detail: str = ""


class RigError(Exception):
    """Base of what a rig can refuse; the message names the thing and the mend."""


class RigBusyError(RigError):
    """A scan is under way."""


class RigNotReadyError(RigError):
    """Arm or camera cannot be used now."""


class PlanRefusedError(RigError):
    """A waypoint cannot be driven to, or a speed is over the cap; nothing moved."""

    def __init__(self, message: str, verdicts: Sequence[WaypointVerdict] = ()) -> None:
        super().__init__(message)
        self.verdicts = tuple(verdicts)


class ScanOverError(RigError):
    """The scan has ended; nothing can be done with it any more."""


class NoRoomError(RigError):
    """A recording cannot be kept."""


class NotForReplaysError(RigError):
    """It needs an arm, and a replay has none."""


class UnknownScanError(RigError):
    """There is no such scan under way."""


class Rig(Protocol):
    """One arm with its camera and worker. Every method may be called from any thread."""

    def plan(self, spec: ScanSpec) -> list[WaypointVerdict]:
        """Check every waypoint; nothing moves."""
        ...

    def start(self, spec: ScanSpec, views_before: int = 0) -> ScanStatus:
        """Begin a scan and return; events tell how it goes.

        views_before: how many are known to be recorded, of a scan of an earlier life; the status
        says so until the recording has been read.

        Raises:
            RigBusyError, RigNotReadyError, PlanRefusedError: nothing moved.
        """
        ...

    def pause(self, scan_id: str) -> ScanStatus:
        """Stop the arm and keep the scan. Raises UnknownScanError."""
        ...

    def resume(self, scan_id: str) -> ScanStatus:
        """Go on at the first missing waypoint. Raises UnknownScanError, RigNotReadyError."""
        ...

    def cancel(self, scan_id: str) -> ScanStatus:
        """Stop the arm and end the scan; its recording stays. Raises UnknownScanError."""
        ...

    def stop(self) -> None:
        """Stop the arm now; never queued, harmless when repeated."""
        ...

    def hold(self, reason: str) -> None:
        """Let nothing move until somebody has acknowledged; the reason is a short sentence."""
        ...

    def end_held(self) -> None:
        """End a scan whose arm is held as STOPPED, so that only a `resume` lets it go on.

        Does nothing while nothing holds the arm. What `acknowledge` does first; who notes stops
        calls it before, to have this one noted.

        Raises:
            RigNotReadyError: the scan has not ended in time; it will, and begins no motion.
        """
        ...

    def acknowledge(self, reason: str) -> None:
        """An operator has looked and says why moving is safe again. Raises RigNotReadyError."""
        ...

    def end(self) -> None:
        """The service is ending: pause the scan under way, and start none any more.

        Returns when nothing moves, or when that cannot be had.
        """
        ...

    def status(self, scan_id: str) -> ScanStatus:
        """Return the scan as it is. Raises UnknownScanError."""
        ...

    def parts(self) -> list[PartStatus]:
        """Return arm, camera, worker and disk."""
        ...

    def recording_path(self, scan_id: str) -> Path:
        """Return where the recording is (`.part` while it grows). Raises UnknownScanError."""
        ...

    def adopt(self, scan_id: str, recording: Path) -> None:
        """Keep a recording from elsewhere as that of a new scan id; the file stays where it is.

        Raises:
            NoRoomError: it cannot be kept; nothing is left of it.
        """
        ...

    def catch_up(self, spec: ScanSpec) -> None:
        """Have the worker fed with the recording of an ended scan, when it has time for it.

        An event CAUGHT_UP tells when it is through, with or without a skeleton of all views.
        """
        ...

    def leave(self, scan_id: str) -> None:
        """Feed nothing more of what `catch_up` was asked for."""
        ...

    def skeleton(self, scan_id: str) -> bytes | None:
        """Return the newest skeleton document (JSON) of a scan; None while there is none."""
        ...

    def subscribe(self, listener: Callable[[RigEvent], None]) -> None:
        """Call `listener` for every event, from any thread; it must return at once."""
        ...
