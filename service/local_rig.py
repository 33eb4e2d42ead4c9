"""The rig of this machine: one arm, one camera, one worker, one scan at a time."""

import logging
import shutil
import threading
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from canopy_skel.errors import RecordingError
from canopy_skel.recording.writer import publish
from drivers.errors import DriverError, MoveRefusedError, NotAcknowledgedError
from drivers.protocols import ArmMode, ToolPose, raise_unless_movable
from drivers.waypoints import after, moves_to
from service.opened import Opened
from service.rig import (
    FINISHED,
    NoRoomError,
    PartStatus,
    PlanRefusedError,
    RigBusyError,
    RigEvent,
    RigNotReadyError,
    ScanSpec,
    ScanState,
    ScanStatus,
    UnknownScanError,
    WaypointVerdict,
)
from service.rig_parts import RigParts
from service.scan import ScanSession, ScanTools

log = logging.getLogger(__name__)

ENOUGH_DISK_BYTES = 1 << 30
STOP_TIMEOUT_S = 10.0
SKELETON_TIMEOUT_S = 10.0


@dataclass(frozen=True, kw_only=True, eq=False, slots=True)
class _Since:
    """How often the arm was stopped, and the newest wish that a scan should not run."""

    stops: int
    called_off: object


class LocalRig:
    """See `service.rig.Rig`. A context manager; leaving it stops the arm and the scan."""

    def __init__(self, parts: RigParts) -> None:
        self._parts = parts
        self._lock = threading.Lock()
        self._arm, self._camera = Opened(parts.arm), Opened(parts.camera)
        self._open = ExitStack()
        self._sessions: dict[str, tuple[ScanSpec, ScanSession]] = {}
        self._launching = threading.Lock()  # held for a moment only, never while a driver is asked
        self._called_off: dict[str, object] = {}
        self._stopped, self._stops = "", 0
        self._ending = False
        self._listeners: list[Callable[[RigEvent], None]] = []

    def __enter__(self) -> "LocalRig":
        """Open arm and camera as far as they are there; what is missing is told by `parts`."""
        for name, device in (("arm", self._arm), ("camera", self._camera)):
            self._open.enter_context(device)
            try:
                device.open()
            except DriverError as error:
                log.warning("%s is not there yet: %s", name, error)
        return self

    def __exit__(self, *reasons: object) -> None:
        """End a scan under way, keeping its recording, and close arm and camera."""
        self.end()
        self._open.close()

    def plan(self, spec: ScanSpec) -> list[WaypointVerdict]:
        """Check every waypoint in order, from where the arm is; nothing moves."""
        try:
            self._arm.open()
            state = self._parts.arm.state()
        except DriverError as error:
            raise _not_ready(error) from error
        verdicts = []
        for index, waypoint in enumerate(spec.waypoints):
            try:
                moves = moves_to(
                    state,
                    waypoint,
                    self._parts.limits,
                    speed_mps=spec.speed_mps,
                    acceleration_mps2=spec.acceleration_mps2,
                )
            except MoveRefusedError as error:
                verdicts.append(WaypointVerdict(index=index, reachable=False, reason=str(error)))
                continue
            verdicts.append(WaypointVerdict(index=index, reachable=True))
            for move in moves:
                state = after(state, move)
        return verdicts

    def start(self, spec: ScanSpec, views_before: int = 0) -> ScanStatus:
        """Begin a scan; see `Rig.start`."""
        since = self._since(spec.scan_id)
        with self._lock:
            self._require_free()
            self._require_ready()
            verdicts = self.plan(spec)
            if not all(verdict.reachable for verdict in verdicts):
                bad = [v for v in verdicts if not v.reachable]
                raise PlanRefusedError(
                    f"{len(bad)} of {len(verdicts)} waypoints cannot be driven to; the first:"
                    f" waypoint {bad[0].index}: {bad[0].reason}",
                    verdicts,
                )
            return self._launch(spec, since, views_before)

    def pause(self, scan_id: str) -> ScanStatus:
        """Stop the arm and keep the scan; a start that is under way comes to nothing."""
        session = self._call_off(scan_id)
        self._interrupt(session, ScanState.PAUSED)
        return session.status

    def resume(self, scan_id: str) -> ScanStatus:
        """Go on at the first missing waypoint."""
        since = self._since(scan_id)
        with self._lock:
            spec, session = self._session(scan_id)
            if session.status.state in FINISHED:
                raise RigNotReadyError(f"scan {scan_id} is {session.status.state}; start a new one")
            self._require_free()
            self._require_ready()
            return self._launch(spec, since, session.status.views_done)

    def cancel(self, scan_id: str) -> ScanStatus:
        """Stop the arm and end the scan; what was recorded stays."""
        session = self._call_off(scan_id)
        self._interrupt(session, ScanState.CANCELLED)
        session.conclude(ScanState.CANCELLED)
        return session.status

    def stop(self) -> None:
        """Stop the arm now, whatever is under way; an acknowledgement is needed afterwards."""
        self._stopped = "the arm was stopped by the operator"
        self._stops += 1
        running = [session for _, session in [*self._sessions.values()] if session.running]
        try:
            if not running:
                self._parts.arm.stop()
            for session in running:
                session.interrupt(ScanState.STOPPED)
        except DriverError as error:
            raise _not_ready(error) from error

    def hold(self, reason: str) -> None:
        """Let nothing move until somebody has acknowledged; an earlier reason stays."""
        self._stopped = self._stopped or reason
        self._stops += 1

    def end_held(self) -> None:
        """End a scan whose arm is held, and starts under way; see `Rig.end_held`.

        A scan that waits for its camera meanwhile has not met the hold, and would never know of it.
        """
        try:
            state = self._parts.arm.state()
            raise_unless_movable(state, also=(ArmMode.MOVING, ArmMode.INTERRUPTED))
        except DriverError as error:
            with self._launching:
                self._stops += 1
                running = [session for _, session in self._sessions.values() if session.running]
            for session in running:
                session.give_up(error)
            for session in running:
                self._join(session, "the arm is held")

    def acknowledge(self, reason: str) -> None:
        """Let the arm move again; a scan goes on only by `resume`."""
        self.end_held()
        stops = self._stops
        try:
            self._arm.open()
            self._parts.arm.acknowledge(reason)
        except DriverError as error:
            raise _not_ready(error) from error
        if self._stops == stops:  # a stop since then wants an acknowledgement of its own
            self._stopped = ""
        self._tell("", "acknowledged", {"reason": reason})

    def end(self) -> None:
        """Pause the scan under way and start none any more; see `Rig.end`."""
        with self._launching:
            self._ending = True
            running = [session for _, session in self._sessions.values() if session.running]
        for session in running:
            try:
                self._interrupt(session, ScanState.PAUSED)
            except RigNotReadyError as error:
                log.warning("a scan under way when the service ended: %s", error)

    def status(self, scan_id: str) -> ScanStatus:
        """Return the scan as it is."""
        return self._session(scan_id)[1].status

    def pose(self) -> tuple[str, ToolPose] | None:
        """Return the scan under way and where its flange is; None while there is neither."""
        for scan_id, (_, session) in [*self._sessions.items()]:
            if session.status.state is ScanState.RUNNING:
                try:
                    return scan_id, self._parts.arm.state().pose
                except DriverError:
                    return None
        return None

    def parts(self) -> list[PartStatus]:
        """Return arm, camera, worker and disk."""
        return [
            self._arm_status(),
            self._camera_status(),
            self._parts.feed.worker(),
            self._disk_status(),
        ]

    def recording_path(self, scan_id: str) -> Path:
        """Return the recording, or what there is of it."""
        path = self._path(scan_id)
        for candidate in (path, path.with_name(path.name + ".part")):
            if candidate.exists():
                return candidate
        raise UnknownScanError(f"there is no recording of scan {scan_id}")

    def adopt(self, scan_id: str, recording: Path) -> None:
        """Keep a recording as that of a new scan id; see `Rig.adopt`."""
        path = self._path(scan_id)
        part = path.with_name(path.name + ".part")
        path.parent.mkdir(parents=True)
        try:
            try:
                part.hardlink_to(recording)
            except OSError:  # the disk knows no links, or it is another one
                shutil.copyfile(recording, part)
            publish(part, path)
        except (OSError, RecordingError) as error:
            shutil.rmtree(path.parent)
            raise NoRoomError(f"{path}: cannot be written ({error}); make room") from error

    def catch_up(self, spec: ScanSpec) -> None:
        """Have the views of an ended scan fed; see `Rig.catch_up`."""
        self._parts.feed.catch_up(spec, self._path(spec.scan_id))

    def leave(self, scan_id: str) -> None:
        """Feed nothing more of it."""
        self._parts.feed.leave(scan_id)

    def skeleton(self, scan_id: str) -> bytes | None:
        """Return the newest skeleton document of a scan."""
        return self._parts.feed.skeleton(scan_id)

    def subscribe(self, listener: Callable[[RigEvent], None]) -> None:
        """Call `listener` for every event."""
        self._listeners.append(listener)

    def announce(self, scan_id: str, kind: str, fields: dict[str, object]) -> None:
        """Tell the listeners of something that happened elsewhere, such as a new skeleton."""
        self._tell(scan_id, kind, fields)

    def _since(self, scan_id: str) -> _Since:
        """Return what a start must find unchanged in the end; read before anything is waited for.

        The camera may take half a minute to be there: time enough to call the start off.
        """
        return _Since(stops=self._stops, called_off=self._called_off.get(scan_id))

    def _call_off(self, scan_id: str) -> ScanSession:
        """Have a start of this scan that is under way come to nothing; return its session."""
        with self._launching:
            self._called_off[scan_id] = object()
            return self._session(scan_id)[1]

    def _launch(self, spec: ScanSpec, since: _Since, views_before: int) -> ScanStatus:
        """Start a session, unless the arm was stopped or the scan called off in the meantime.

        The session is there to be stopped before that is looked at: no stop falls in between.
        """
        before = self._sessions.get(spec.scan_id)
        session = self._session_for(spec, views_before, before[1].exposed_ns if before else {})
        try:
            session.path.parent.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise RigNotReadyError(f"disk: {_unwritable(session.path.parent, error)}") from error
        with self._launching:
            self._sessions[spec.scan_id] = (spec, session)
            try:
                self._require_unchanged(spec.scan_id, since)
                self._parts.feed.begin(spec, session.path)
                session.start()
            except Exception:
                if before is None:
                    del self._sessions[spec.scan_id]
                else:
                    self._sessions[spec.scan_id] = before
                raise
        return session.status

    def _require_unchanged(self, scan_id: str, since: _Since) -> None:
        if self._ending:
            raise RigNotReadyError("the service is ending")
        if self._called_off.get(scan_id) is not since.called_off:
            raise RigNotReadyError(f"scan {scan_id} was paused or cancelled meanwhile")
        if self._stops != since.stops:
            held = self._hold() or "it was stopped meanwhile; look at it, then try again"
            raise RigNotReadyError(f"arm: {held}")

    def _hold(self) -> str:
        """Return why nothing may move, whatever the arm says; nothing if it may."""
        stopped = self._stopped
        return stopped and f"{stopped}: look at the arm, then acknowledge with a reason"

    def _session_for(
        self, spec: ScanSpec, views_before: int, exposed_before: Mapping[int, int]
    ) -> ScanSession:
        parts = self._parts
        return ScanSession(
            spec,
            ScanTools(
                arm=parts.arm,
                camera=parts.camera,
                limits=parts.limits,
                tool_from_camera=parts.tool_from_camera,
                attachments=parts.attachments,
                stage=parts.stage,
            ),
            self._path(spec.scan_id),
            report=lambda kind, fields: self._tell(spec.scan_id, kind, fields),
            recorded=partial(parts.feed.offer, spec.scan_id),
            conclude_with=self._conclude,
            views_before=views_before,
            exposed_before=exposed_before,
        )

    def _conclude(self, state: ScanState, detail: str) -> None:
        """Let the last views become a skeleton; hold the arm after what nobody asked for."""
        if state is ScanState.DONE and not self._parts.feed.flush(SKELETON_TIMEOUT_S):
            log.warning("the skeleton of the last views is not there yet")
        if state in (ScanState.STOPPED, ScanState.FAILED) and detail:
            self.hold(f"the scan was stopped ({detail})")

    def _interrupt(self, session: ScanSession, wanted: ScanState) -> None:
        try:
            session.interrupt(wanted)
        except DriverError as error:
            raise _not_ready(error) from error
        self._join(session, "the arm was told to stop")

    def _join(self, session: ScanSession, why: str) -> None:
        if not session.join(STOP_TIMEOUT_S):
            raise RigNotReadyError(
                f"{why} but the scan has not ended within {STOP_TIMEOUT_S:.0f} s;"
                " look at the arm, then try again"
            )

    def _session(self, scan_id: str) -> tuple[ScanSpec, ScanSession]:
        if scan_id not in self._sessions:
            raise UnknownScanError(f"there is no scan {scan_id} on this rig")
        return self._sessions[scan_id]

    def _path(self, scan_id: str) -> Path:
        return self._parts.data / "scans" / scan_id / f"{scan_id}.mcap"

    def _require_free(self) -> None:
        for spec, session in self._sessions.values():
            if session.status.state is ScanState.RUNNING:
                raise RigBusyError(
                    f"scan {spec.scan_id} is under way; wait for it, or pause or cancel it"
                )

    def _require_ready(self) -> None:
        for part in (self._arm_status(), self._camera_status(), self._disk_status()):
            if not part.ready:
                raise RigNotReadyError(f"{part.name}: {part.detail}")

    def _arm_status(self) -> PartStatus:
        detail = _trouble(self._arm) or self._hold()
        return PartStatus(name="arm", ready=not detail, detail=detail)

    def _camera_status(self) -> PartStatus:
        detail = _trouble(self._camera)
        return PartStatus(name="camera", ready=not detail, detail=detail)

    def _disk_status(self) -> PartStatus:
        try:
            self._parts.data.mkdir(parents=True, exist_ok=True)
            free = shutil.disk_usage(self._parts.data).free
        except OSError as error:
            detail = _unwritable(self._parts.data, error)
            return PartStatus(name="disk", ready=False, detail=detail)
        detail = "" if free >= ENOUGH_DISK_BYTES else f"only {free >> 20} MiB free; make room"
        return PartStatus(name="disk", ready=not detail, detail=detail)

    def _tell(self, scan_id: str, kind: str, fields: dict[str, object]) -> None:
        event = RigEvent(scan_id=scan_id, kind=kind, fields=fields)
        for listener in self._listeners:
            listener(event)


def _not_ready(error: DriverError) -> RigNotReadyError:
    return RigNotReadyError(f"arm: {type(error).__name__}: {error}")


def _unwritable(path: Path, error: OSError) -> str:
    return f"{path}: cannot be written ({error.strerror}); check the disk"


def _trouble(device: Opened) -> str:
    """Return why a device cannot be used and how to mend it, nothing if it can."""
    try:
        device.check()
    except NotAcknowledgedError as error:
        return f"{error}; look at the arm, then acknowledge with a reason"
    except DriverError as error:
        return f"{type(error).__name__}: {error}"
    return ""
