"""A rig without hardware: tests say what happens, `service.rig.Rig` is what it answers to."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from threading import RLock

from service.rig import (
    FINISHED,
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

ROOT = Path(__file__).parents[2]
DEMO_RECORDING = ROOT / "recordings/demo_apple.mcap"


class FakeRig:
    """Takes one scan at a time; waypoints further out than `reach_m` are refused."""

    def __init__(self, recording: Path = DEMO_RECORDING, reach_m: float = 1.0) -> None:
        self.recording = recording
        self.reach_m = reach_m
        self.refusal: Exception | None = None
        self.broken_parts: dict[str, str] = {}
        self.specs: list[ScanSpec] = []
        self.stops = 0
        self.acknowledged: list[str] = []
        self.holds: list[str] = []
        self.to_catch_up: list[str] = []
        self.fed: list[ScanSpec] = []
        self.left: list[str] = []
        self.adopted: dict[str, bytes] = {}
        self._scans: dict[str, ScanStatus] = {}
        self._skeletons: dict[str, bytes] = {}
        self._listeners: list[Callable[[RigEvent], None]] = []
        self._lock = RLock()

    # What tests do.

    def photograph(self, scan_id: str, index: int) -> None:
        """Have a view arrive."""
        self.become(scan_id, views_done=index + 1)
        self.tell(scan_id, "view", index=index)

    def publish(self, scan_id: str, skeleton: bytes) -> None:
        """Have the worker publish a skeleton."""
        self._skeletons[scan_id] = skeleton
        self.tell(scan_id, "skeleton", revision=json.loads(skeleton)["revision"])

    def finish(self, scan_id: str) -> None:
        """Have the scan come to its end."""
        self.become(scan_id, state=ScanState.DONE)
        self.tell(scan_id, "done")

    def become(self, scan_id: str, **changes: object) -> None:
        """Change the status without telling."""
        with self._lock:
            self._scans[scan_id] = replace(self.status(scan_id), **changes)

    def tell(self, scan_id: str, kind: str, **fields: object) -> None:
        """Tell every listener of an event."""
        for listener in self._listeners:
            listener(RigEvent(scan_id=scan_id, kind=kind, fields=fields))

    # What a rig does.

    def plan(self, spec: ScanSpec) -> list[WaypointVerdict]:
        verdicts = []
        for i, pose in enumerate(spec.waypoints):
            far = abs(pose[:3, 3]).max() > self.reach_m
            reason = f"waypoint {i} is out of reach" if far else ""
            verdicts.append(WaypointVerdict(index=i, reachable=not far, reason=reason))
        return verdicts

    def start(self, spec: ScanSpec, views_before: int = 0) -> ScanStatus:
        with self._lock:
            self._refuse(spec)
            self.specs.append(spec)
            self._scans[spec.scan_id] = ScanStatus(
                scan_id=spec.scan_id,
                tree_id=spec.tree_id,
                state=ScanState.RUNNING,
                views_done=views_before,
                views_total=len(spec.waypoints),
            )
        self.tell(spec.scan_id, "started")
        return self.status(spec.scan_id)

    def _refuse(self, spec: ScanSpec) -> None:
        if self.refusal is not None:
            raise self.refusal
        for status in self._scans.values():
            if status.state not in FINISHED:
                raise RigBusyError(f"scan {status.scan_id} is under way; wait or cancel it")
        verdicts = self.plan(spec)
        if not all(verdict.reachable for verdict in verdicts):
            raise PlanRefusedError("some waypoints cannot be driven to", verdicts)

    def pause(self, scan_id: str) -> ScanStatus:
        return self._command(scan_id, ScanState.PAUSED)

    def resume(self, scan_id: str) -> ScanStatus:
        self.status(scan_id)
        if self.refusal is not None:
            raise self.refusal
        return self._command(scan_id, ScanState.RUNNING)

    def cancel(self, scan_id: str) -> ScanStatus:
        return self._command(scan_id, ScanState.CANCELLED)

    def _command(self, scan_id: str, state: ScanState) -> ScanStatus:
        self.become(scan_id, state=state)
        self.tell(scan_id, state.value)
        return self.status(scan_id)

    def stop(self) -> None:
        self.stops += 1

    def hold(self, reason: str) -> None:
        self.holds.append(reason)

    def end(self) -> None:
        pass

    def end_held(self) -> None:
        pass

    def acknowledge(self, reason: str) -> None:
        if isinstance(self.refusal, RigNotReadyError):
            raise self.refusal
        self.acknowledged.append(reason)

    def status(self, scan_id: str) -> ScanStatus:
        if scan_id not in self._scans:
            raise UnknownScanError(f"no scan {scan_id} is under way")
        return self._scans[scan_id]

    def parts(self) -> list[PartStatus]:
        return [
            PartStatus(name=name, ready=name not in self.broken_parts, detail=detail)
            for name in ("arm", "camera", "worker", "disk")
            for detail in [self.broken_parts.get(name, "")]
        ]

    def adopt(self, scan_id: str, recording: Path) -> None:
        if self.refusal is not None:
            raise self.refusal
        self.adopted[scan_id] = recording.read_bytes()

    def recording_path(self, scan_id: str) -> Path:
        self.status(scan_id)
        return self.recording

    def catch_up(self, spec: ScanSpec) -> None:
        self.to_catch_up.append(spec.scan_id)
        self.fed.append(spec)

    def leave(self, scan_id: str) -> None:
        self.left.append(scan_id)

    def skeleton(self, scan_id: str) -> bytes | None:
        return self._skeletons.get(scan_id)

    def subscribe(self, listener: Callable[[RigEvent], None]) -> None:
        self._listeners.append(listener)
