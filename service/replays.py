"""Replays over HTTP: a recording that is there becomes a skeleton, and no arm moves."""

import json
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from threading import Lock, Timer
from typing import Any

from canopy_skel.errors import RecordingError
from canopy_skel.messages import TOPICS
from canopy_skel.recording import Recording, read_recording
from service.catalogue import Catalogue, RevisionRecord
from service.rig import (
    CAUGHT_UP,
    FINISHED,
    Rig,
    RigError,
    RigEvent,
    ScanKind,
    ScanOverError,
    ScanSpec,
    ScanState,
    ScanStatus,
    UnknownScanError,
    status_fields,
)
from service.specs import fields_of

_AGAIN_S = 5.0


def replayable(path: Path) -> Recording:
    """Return a recording whose views can go over the bus as they are.

    Raises:
        RecordingError: it cannot be read, has no whole view or two of one index, or holds other
            messages than canopy's.
    """
    recording = read_recording(path)
    mend = "replay it where it lies, with `canopy replay`, which knows other messages too"
    if recording.file.profile == "ros2":
        raise RecordingError(f"ROS 2 wrote it; {mend}")
    for channel in recording.file.channels.values():
        topic = TOPICS.get(channel.topic)
        schema = recording.file.schema_of(channel.id).name
        if topic is not None and schema != topic.schema:
            raise RecordingError(f"{channel.topic} holds {schema}, not {topic.schema}; {mend}")
    indices = Counter(group.index for group in recording.groups)
    if len(indices) < len(recording.groups):  # the bus knows a view by its index
        twice = [index for index, views in indices.items() if views > 1]
        raise RecordingError(
            f"it has several views of index {', '.join(map(str, twice))}; number them anew by"
            " `sequence`, or replay it where it lies, with `canopy replay`, which uses the first"
        )
    if not whole_views(recording):
        raise RecordingError("it has no whole view; `canopy inspect` says what it has")
    return recording


def whole_views(recording: Recording) -> int:
    """Return how many views there are to send."""
    return sum(not group.partial for group in recording.groups)


def has_masks(recording: Recording) -> bool:
    """Say whether somebody's branch masks are in it."""
    return any("instances" in group.refs for group in recording.groups)


class Replays:
    """Replays of recordings. Every method may be called from any thread.

    tell: takes what happens to them, to be noted; must return at once.
    """

    def __init__(self, rig: Rig, catalogue: Catalogue, tell: Callable[[RigEvent], None]) -> None:
        self._rig = rig
        self._catalogue = catalogue
        self._tell = tell
        self._starting = Lock()
        self._changing = Lock()

    def start(
        self,
        spec: ScanSpec,
        recording: Recording,
        key: str | None,
        body_sha256: str,
    ) -> Mapping[str, Any]:
        """Have a recording made into a skeleton and return the status fields.

        The worker turns to it when the scan under way, if there is one, leaves it time. It is
        noted first: whatever happens then, the next service goes on with it or says why not.

        Args:
            spec: without waypoints.
            recording: is kept as that of the replay; the file stays where it is.
            key: the same key starts it once; None = each request is another.
            body_sha256: of the request.

        Raises:
            KeyReusedError: the key was used for another body.
            NoRoomError: the recording cannot be kept; the key is free.
        """
        lost = (line.removeprefix(f"{recording.path.name}: ") for line in recording.warnings)
        status = ScanStatus(
            scan_id=spec.scan_id,
            tree_id=spec.tree_id,
            state=ScanState.RUNNING,
            views_done=0,
            views_total=whole_views(recording),
            detail="; ".join(lost),
        )
        answer = status_fields(status)
        with self._starting:
            before = self._catalogue.answer(key, body_sha256)
            if before is not None:
                return before
            request = fields_of(spec)
            self._catalogue.add_scan(status, request, key, body_sha256, answer, ScanKind.REPLAY)
            try:
                self._rig.adopt(spec.scan_id, recording.path)
            except RigError:
                self._catalogue.drop_scan(spec.scan_id)
                raise
        self._tell(RigEvent(scan_id=spec.scan_id, kind="started"))
        self.feed(spec)
        return answer

    def feed(self, spec: ScanSpec) -> None:
        """Have the worker fed with a recording, unless it is that of a replay that has ended."""
        with self._changing:
            record = self._catalogue.scan(spec.scan_id)
            if record is None or record.kind is ScanKind.SCAN or record.state not in FINISHED:
                self._rig.catch_up(spec)

    def cancel(self, scan_id: str) -> ScanStatus:
        """End a replay; its recording stays. Raises ScanOverError."""
        with self._changing:
            status = self._status(scan_id)
            if status.state in FINISHED:
                raise ScanOverError(f"scan {scan_id} is {status.state.value}; start a new one")
            status = replace(status, state=ScanState.CANCELLED, detail="cancelled")
            self._catalogue.update(status)
            self._rig.leave(scan_id)
        self._tell(RigEvent(scan_id=scan_id, kind="cancelled"))
        return status

    def after(self, event: RigEvent) -> ScanStatus:
        """Note where a replay is when something was told of it, and return that."""
        with self._changing:
            status = self._status(event.scan_id)
            if status.state not in FINISHED:
                newest = self._catalogue.newest_revision(event.scan_id)
                status = _status_after(event, status, newest)
                self._catalogue.update(status)
        return status

    def tell_again(self, event: RigEvent) -> None:
        """Have an end noted later, of a replay or a scan: nothing else will ever say so."""
        if event.kind == CAUGHT_UP or event.kind in FINISHED:
            again = Timer(_AGAIN_S, self._tell, (event,))
            again.daemon = True
            again.start()

    def _status(self, scan_id: str) -> ScanStatus:
        record = self._catalogue.scan(scan_id)
        if record is None:
            raise UnknownScanError(f"there is no scan {scan_id!r}")
        return record.status


def _status_after(event: RigEvent, status: ScanStatus, newest: RevisionRecord | None) -> ScanStatus:
    """Return where a replay is. newest: its newest skeleton; views it knows are done."""
    document = {} if newest is None else json.loads(newest.path.read_bytes())
    views = document.get("views", {"used": 0, "rejected": []})
    status = replace(status, views_done=views["used"] + len(views["rejected"]))
    if event.kind != CAUGHT_UP:
        return status
    whole = status.views_done >= status.views_total and not document.get("preview")
    if whole:
        return replace(status, state=ScanState.DONE)
    if event.fields["views"] != status.views_total:
        why = "its recording cannot be read any more"
    elif event.fields["refused"]:
        why = f"no worker could take views {event.fields['refused']}"
    else:
        why = "no view of it is usable; `canopy inspect` says why"
    return replace(status, state=ScanState.FAILED, detail=why)
