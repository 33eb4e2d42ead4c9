"""One scan: plan -> move -> settle -> capture -> quality gate -> next, with a journal.

A session runs in a thread of its own until the scan is done or something stops it; it then leaves
the recording unfinished (`.part`), and going on is a new session that carries the whole views over
and begins at the first missing waypoint. There is no other way to continue, so the way after a
power cut is the way after a pause.
"""

import json
import logging
import threading
import time
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType

from canopy_skel.errors import CanopyError, RecordingError
from canopy_skel.frame import View
from canopy_skel.geometry import FloatArray
from canopy_skel.messages import Message
from canopy_skel.recording import RecordingWriter, carry_over, metadata_of, read_recording
from canopy_skel.recording.writer import disk_errors, sync_folder
from drivers.errors import DriverError
from drivers.guarded_arm import Limits
from drivers.protocols import (
    Arm,
    ArmMode,
    ArmState,
    Camera,
    CameraImage,
    raise_unless_movable,
    wait_settled,
)
from drivers.quality import QualityLimits, flaws, moved
from drivers.waypoints import moves_to, travel_s
from service.rig import FINISHED, ScanSpec, ScanState, ScanStatus

log = logging.getLogger(__name__)

Report = Callable[[str, dict[str, object]], None]
Stage = Callable[[str], AbstractContextManager[None]]
Attachments = Callable[[Collection[int] | None], Mapping[str, bytes]]
"""Files that go with a finished recording, by name, from when its pictures were exposed (ns of the
host's monotonic clock); None where an earlier life of the service took some of them."""

_HAND_EYE = "tool_from_camera"
SLOWED_DOWN = 2.0
"""Times the planned duration that a move may take: the pendant's slider slows moves down."""


class ScanInterruptedError(Exception):
    """The operator paused or cancelled the scan."""


class PictureRefusedError(Exception):
    """No try at a waypoint gave a good picture."""


@dataclass(frozen=True, kw_only=True, eq=False, slots=True)
class ScanTools:
    """What a scan works with.

    tool_from_camera: (4, 4), the hand-eye calibration. stage: entered around each step, by its
    name.
    """

    arm: Arm
    camera: Camera
    limits: Limits
    tool_from_camera: FloatArray
    quality: QualityLimits = field(default_factory=QualityLimits)
    attachments: Attachments = lambda exposed_ns: {}
    stage: Stage = lambda name: nullcontext()


class ScanSession:
    """Drives one scan from where it is to its end, or until it is interrupted or stopped.

    `report(kind, fields)` is told of everything that happens, from the session's thread;
    `recorded(index, messages)` that a view is safe on disk, with its messages if it was recorded
    just now: to read them again costs the more the longer the scan is.
    `conclude_with(state, detail)` is called before the scan is said to have ended, and when nothing
    moves any more. views_before: recorded by earlier sessions as far as is known; told until the
    recording has been read. exposed_before: when the pictures of those were exposed, by view, as
    far as is known.
    """

    def __init__(
        self,
        spec: ScanSpec,
        tools: ScanTools,
        path: Path,
        *,
        report: Report,
        recorded: Callable[[int, Sequence[Message]], None],
        conclude_with: Callable[[ScanState, str], None] = lambda state, detail: None,
        views_before: int = 0,
        exposed_before: Mapping[int, int] = MappingProxyType({}),
    ) -> None:
        self.path = path
        self._spec = spec
        self._tools = tools
        self._report = report
        self._recorded = recorded
        self._conclude_with = conclude_with
        self._wanted: ScanState | None = None
        self._held: DriverError | None = None
        self._state = ScanState.RUNNING
        self._detail = ""
        self._done: set[int] = set()
        self._views_done = views_before
        self._exposed_ns = dict(exposed_before)
        self._lock = threading.Lock()
        self._epoch_ns = time.time_ns() - time.monotonic_ns()
        self._thread = threading.Thread(target=self._run, name=f"scan-{spec.scan_id}", daemon=True)

    def start(self) -> None:
        """Begin, in a thread."""
        self._thread.start()

    def join(self, timeout_s: float) -> bool:
        """Wait for the session to end; say whether it has."""
        self._thread.join(timeout_s)
        return not self._thread.is_alive()

    @property
    def running(self) -> bool:
        """Whether it has not ended; known at once, also while a move is being begun."""
        return self._state is ScanState.RUNNING

    @property
    def exposed_ns(self) -> Mapping[int, int]:
        """When the picture of each view was exposed, as far as this process knows."""
        return dict(self._exposed_ns)

    @property
    def status(self) -> ScanStatus:
        """The scan as it is now."""
        with self._lock:
            return ScanStatus(
                scan_id=self._spec.scan_id,
                tree_id=self._spec.tree_id,
                state=self._state,
                views_done=self._views_done,
                views_total=len(self._spec.waypoints),
                detail=self._detail,
            )

    def interrupt(self, wanted: ScanState) -> None:
        """Stop the arm at once and end the session as `wanted`.

        When this returns, the session begins no further motion. The first stop does not wait for
        the lock, which is held while a move is being begun; the second is for that move, also where
        the first has failed. A session that has ended moves nothing: the arm may be another's.

        Raises:
            DriverError: a stop was not confirmed.
        """
        if not self.running:
            return
        self._wanted = self._wanted or wanted
        try:
            self._tools.arm.stop()
        finally:
            with self._lock:
                under_way = self._state is ScanState.RUNNING
            if under_way:
                self._tools.arm.stop()

    def give_up(self, held: DriverError) -> None:
        """End the session with what holds the arm, which it need not have met itself.

        It begins no further motion, also when the arm is let go; `join` tells when it has ended.
        """
        self._held = held

    def conclude(self, state: ScanState) -> None:
        """Set the state of a session that rests: an operator's decision. What is over stays so."""
        with self._lock:
            running = self._state is ScanState.RUNNING and self._thread.is_alive()
            if not running and self._state not in FINISHED:
                self._state = state

    def _run(self) -> None:
        try:
            self._scan()
        except ScanInterruptedError:
            self._end(self._wanted or ScanState.PAUSED, "")
        # A disk can refuse anything at any time; mended, it lets the scan go on.
        except (DriverError, CanopyError, PictureRefusedError, OSError) as error:
            if self._wanted is None:
                self._end(ScanState.STOPPED, self._drop_motion(error))
            else:  # the interruption makes the driver complain of the move it cut short
                self._end(self._wanted, "")
        except Exception as error:
            log.exception("scan %s failed", self._spec.scan_id)
            self._end(ScanState.FAILED, self._drop_motion(error))

    def _drop_motion(self, error: Exception) -> str:
        """Drop whatever the error left of a move; return what the operator must know.

        What another program moves since is none of this scan's.
        """
        detail = f"{type(error).__name__}: {error}"
        try:
            self._tools.arm.drop()
        except DriverError as unstopped:
            return f"{detail}; {unstopped}"
        return detail

    def _scan(self) -> None:
        if self.path.exists():  # whole, but the service ended before it could say so
            views = (view for view in read_recording(self.path).views() if isinstance(view, View))
            self._take_over(view.index for view in views)
        else:
            self._record()
        self._end(ScanState.DONE, "")

    def _record(self) -> None:
        metadata = {"scan_id": self._spec.scan_id, "tree_id": self._spec.tree_id}
        metadata["config_sha256"] = self._spec.config.sha256()
        metadata[_HAND_EYE] = json.dumps(self._tools.tool_from_camera.tolist())
        source = set_aside(self.path)
        if source is not None:
            _require_same(metadata[_HAND_EYE], source)
        with RecordingWriter(
            self.path, metadata, tool_from_camera=self._tools.tool_from_camera
        ) as writer:
            if source is not None:
                indices = carry_over(source, writer)
                with disk_errors(source):
                    source.unlink()
                    # If it came back after a power cut, it would count for more than what has
                    # been recorded since (`set_aside`).
                    sync_folder(source.parent)
                self._take_over(indices)
            self._note(writer, "running", views_done=len(self._done))
            try:
                self._visit_all(writer)
            except (DriverError, PictureRefusedError, ScanInterruptedError) as error:
                self._note(writer, "interrupted", reason=str(error))
                raise
            for name, content in self._attachments().items():
                writer.attach(name, "application/json", content)
            writer.write_event(time.time_ns(), {"kind": "done", "views_done": len(self._done)})

    def _attachments(self) -> Mapping[str, bytes]:
        exposed_ns = [self._exposed_ns[index] for index in self._done if index in self._exposed_ns]
        return self._tools.attachments(exposed_ns if len(exposed_ns) == len(self._done) else None)

    def _take_over(self, indices: Iterable[int]) -> None:
        self._count(*indices)
        for index in sorted(self._done):
            self._recorded(index, ())

    def _count(self, *indices: int) -> None:
        with self._lock:
            self._done.update(indices)
            self._views_done = len(self._done)

    def _visit_all(self, writer: RecordingWriter) -> None:
        stage = self._tools.stage
        for index, waypoint in enumerate(self._spec.waypoints):
            if index in self._done:
                continue
            self._check_wanted()
            state = self._drive_to(waypoint)
            view = self._capture(index, state, writer)
            with stage("record"):
                messages = writer.write_view(view)
            self._count(index)
            with stage("bus"):
                self._recorded(index, messages)
            with stage("journal"):
                self._note(writer, "view", index=index)

    def _drive_to(self, waypoint: FloatArray) -> ArmState:
        arm, spec, stage = self._tools.arm, self._spec, self._tools.stage
        with stage("plan"):
            state = arm.state()
            raise_unless_movable(state, also=(ArmMode.INTERRUPTED,))
            moves = moves_to(
                state,
                waypoint,
                self._tools.limits,
                speed_mps=spec.speed_mps,
                acceleration_mps2=spec.acceleration_mps2,
            )
        for move in moves:
            with stage("command"), self._lock:
                self._check_wanted()
                arm.start_move(move)
                if self._wanted or self._held:  # a stop since then was too early, or has failed
                    arm.stop()
                    self._check_wanted()
            with stage("settle"):
                timeout_s = SLOWED_DOWN * travel_s(state, move) + spec.settle_timeout_s
                state = wait_settled(arm, timeout_s=timeout_s)
        return state

    def _capture(self, index: int, before: ArmState, writer: RecordingWriter) -> View:
        reasons: list[str] = []
        for attempt in range(self._spec.retakes + 1):
            self._check_wanted()
            raise_unless_movable(before, also=(ArmMode.INTERRUPTED,))
            with self._tools.stage("grab"):
                image = self._tools.camera.grab(self._spec.grab_timeout_s)
            with self._tools.stage("gate"):
                after = self._tools.arm.state()
                shift = moved(
                    before.pose.base_from_tool0, after.pose.base_from_tool0, self._tools.quality
                )
                reasons = [*flaws(image, self._tools.quality), *([shift] if shift else [])]
            if not reasons:
                self._exposed_ns[index] = image.stamp_ns
                return self._view(index, image, after)
            self._note(writer, "retake", index=index, attempt=attempt, reasons=reasons)
            before = after
        raise PictureRefusedError(
            f"waypoint {index}: {'; '.join(reasons)}; clean the lens, light the tree or move the"
            " waypoint, then acknowledge and resume"
        )

    def _view(self, index: int, image: CameraImage, state: ArmState) -> View:
        return View(
            index=index,
            stamp_ns=image.stamp_ns + self._epoch_ns,
            color_rgb=image.color_rgb,
            intrinsics=image.intrinsics,
            base_from_camera=state.pose.base_from_tool0 @ self._tools.tool_from_camera,
            depth_m=image.depth_m,
            stereo=image.stereo,
            instances=image.instances,
            scores=image.scores,
        )

    def _check_wanted(self) -> None:
        if self._wanted is not None:
            raise ScanInterruptedError(f"{self._wanted} by the operator")
        if self._held is not None:
            raise self._held

    def _note(self, writer: RecordingWriter, kind: str, **fields: object) -> None:
        writer.write_event(time.time_ns(), {"kind": kind, **fields})
        self._report(kind, fields)

    def _end(self, state: ScanState, detail: str) -> None:
        self._conclude_with(state, detail)
        with self._lock:
            self._state, self._detail = state, detail
        self._report(str(state), {"detail": detail} if detail else {})


def _require_same(hand_eye: str, source: Path) -> None:
    """Refuse to go on with views of another hand-eye calibration: they would not fit together."""
    begun_with = metadata_of(source).get(_HAND_EYE, hand_eye)
    if begun_with != hand_eye:
        raise RecordingError(
            "this scan was begun with another tool_from_camera; cancel it and scan the tree anew"
        )


def set_aside(path: Path) -> Path | None:
    """Put what an earlier session left of a recording aside, to be carried over; None if nothing.

    A file that is aside already was not carried over to the end; it holds all that its copy does.

    Raises:
        RecordingError: the disk does not let it; what there is stays.
    """
    part, aside = path.with_name(path.name + ".part"), path.with_name(path.name + ".aside")
    with disk_errors(path):
        if aside.exists():
            part.unlink(missing_ok=True)
        elif part.exists():
            part.rename(aside)
        return aside if aside.exists() else None
