"""Scans as HTTP offers them: the rig's live ones and the catalogue's past ones as one."""

import json
import logging
from collections.abc import Callable, Collection, Mapping
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from queue import SimpleQueue
from threading import Event, Lock, Thread
from types import TracebackType
from typing import Any, Self

from sqlalchemy.exc import OperationalError, SQLAlchemyError

from service.bell import Bell
from service.catalogue import Catalogue, ScanRecord
from service.incomplete import incomplete
from service.replays import Replays
from service.rig import (
    FINISHED,
    NotForReplaysError,
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
from service.specs import fields_of, spec_from

logger = logging.getLogger(__name__)
_JOURNAL_TIMEOUT_S = 1.0
_HOLDING = (ScanState.STOPPED, ScanState.FAILED)


class Scans:
    """Entering takes up what a killed service left, and begins to note the rig's events.

    Every method may be called from any thread; none may be called in an event loop.
    """

    def __init__(self, rig: Rig, catalogue: Catalogue, bell: Bell) -> None:
        self.catalogue = catalogue
        self._rig = rig
        self._bell = bell
        self._events: SimpleQueue[RigEvent | Event | None] = SimpleQueue()
        self._starting = Lock()
        self._refreshing = Lock()
        self._journal = Thread(target=self._write_journal, name="journal", daemon=True)
        self._closing = Event()
        self.replays = Replays(rig, catalogue, self._events.put)

    def __enter__(self) -> Self:
        """Recover the catalogue, follow the rig, and have skeletons made that are not complete."""
        interrupted = self.catalogue.recover()
        for scan_id in interrupted:
            logger.warning("scan was under way when the service ended scan_id=%s", scan_id)
            self._rig.hold(f"the service ended during scan {scan_id}")
            self._add_event(self.record(scan_id).status, "interrupted", {})
        for left in self.catalogue.unfinished():  # whoever acknowledged told a rig that is gone
            scan_id = left.status.scan_id
            self._rig.hold(f"scan {scan_id} was stopped before the service was started again")
        if self.catalogue.last_stop():
            self._rig.hold("the arm was stopped before the service was started again")
        self._rig.subscribe(self._events.put)
        self._journal.start()
        self._catching_up = Thread(
            target=self._catch_up, args=(interrupted,), name="catch up", daemon=True
        )
        self._catching_up.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        """Note what is still to be noted, unless the rig holds it up."""
        self._closing.set()
        self._events.put(None)
        self._journal.join(_JOURNAL_TIMEOUT_S)
        self._catching_up.join(_JOURNAL_TIMEOUT_S)

    def start(self, spec: ScanSpec, key: str, body_sha256: str) -> Mapping[str, Any]:
        """Start a scan and return its status fields; once for each key, whatever happens.

        Scan and key are noted before the arm may move: after a crash the same key finds the scan
        that was under way instead of starting another.

        Raises:
            KeyReusedError: the key was used for another body.
            RigBusyError, RigNotReadyError, PlanRefusedError: nothing moved, the key is free.
        """
        with self._starting:
            before = self.catalogue.answer(key, body_sha256)
            return before or self._start(spec, key, body_sha256)

    def _start(self, spec: ScanSpec, key: str, body_sha256: str) -> Mapping[str, Any]:
        status = ScanStatus(
            scan_id=spec.scan_id,
            tree_id=spec.tree_id,
            state=ScanState.RUNNING,
            views_done=0,
            views_total=len(spec.waypoints),
        )
        answer = status_fields(status)
        self.catalogue.add_scan(status, fields_of(spec), key, body_sha256, answer)
        try:
            self._rig.start(spec)
        except RigError:
            self.catalogue.drop_scan(spec.scan_id)
            raise
        except Exception as error:
            failed = replace(status, state=ScanState.FAILED, detail=f"could not start: {error}")
            self.catalogue.update(failed)
            raise
        self._refresh(spec.scan_id)
        return answer

    def record(self, scan_id: str) -> ScanRecord:
        """Return what is known of a scan.

        Raises:
            UnknownScanError: there never was one.
        """
        record = self.catalogue.scan(scan_id)
        if record is None:
            raise UnknownScanError(f"there is no scan {scan_id!r}; GET /v1/scans lists them")
        return record

    def status(self, scan_id: str) -> ScanStatus:
        """Return a scan as it is now, or as it ended. Raises UnknownScanError."""
        return self.status_of(self.record(scan_id))

    def status_of(self, record: ScanRecord) -> ScanStatus:
        """Return the status of a scan: the rig's word where it has one."""
        if record.state in FINISHED:
            return record.status
        try:
            return self._rig.status(record.scan_id)
        except UnknownScanError:
            return record.status

    def recording(self, scan_id: str) -> Path | None:
        """Return where the recording of a scan is, None while there is none."""
        return self._recording_path(scan_id) or self.record(scan_id).recording

    def active(self) -> ScanStatus | None:
        """Return the newest scan that can still go on, None if there is none."""
        statuses = map(self.status_of, self.catalogue.unfinished())
        return next((one for one in statuses if one.state not in FINISHED), None)

    def stop(self) -> None:
        """Stop the arm, then note it: a service that is started again holds the arm.

        That it cannot be noted is no error: the arm was stopped, whoever is waiting must know.
        """
        try:
            self._rig.stop()
        finally:
            try:
                self.catalogue.add_stop()
            except SQLAlchemyError:
                logger.exception("stop not noted")

    def acknowledge(self, reason: str) -> None:
        """Let the arm move again, and forget the stops until now. Raises RigNotReadyError."""
        self._rig.end_held()
        self._catch_up_journal()  # a stop that is noted later would count as one after this
        last = self.catalogue.last_stop()  # one during the acknowledgement wants its own
        self._rig.acknowledge(reason)
        try:
            self.catalogue.drop_stops(last)
        except SQLAlchemyError:
            logger.exception("acknowledgement not noted")

    def pause(self, scan_id: str) -> ScanStatus:
        """Stop the arm and keep the scan. Raises UnknownScanError, NotForReplaysError."""
        self._require_arm(scan_id)
        return self._command(scan_id, self._rig.pause, lambda record: record.status)

    def resume(self, scan_id: str) -> ScanStatus:
        """Go on with a scan, also with one of an earlier life of the service.

        Raises:
            UnknownScanError, NotForReplaysError, RigBusyError, RigNotReadyError,
            PlanRefusedError: nothing moved.
        """
        self._require_arm(scan_id)

        def again(record: ScanRecord) -> ScanStatus:
            return self._rig.start(spec_from(record.scan_id, record.request), record.views_done)

        return self._command(scan_id, self._rig.resume, again)

    def cancel(self, scan_id: str) -> ScanStatus:
        """End a scan or replay; its recording stays. Raises UnknownScanError, ScanOverError."""
        if self.record(scan_id).kind is ScanKind.REPLAY:
            return self.replays.cancel(scan_id)

        def end(record: ScanRecord) -> ScanStatus:
            status = replace(record.status, state=ScanState.CANCELLED, detail="cancelled")
            self._add_event(status, "cancelled", {})
            return status

        return self._command(scan_id, self._rig.cancel, end)

    def _command(
        self,
        scan_id: str,
        ask_rig: Callable[[str], ScanStatus],
        without_rig: Callable[[ScanRecord], ScanStatus],
    ) -> ScanStatus:
        """Have the rig do it; do it without where only the catalogue knows the scan."""
        self._require_unfinished(scan_id)
        try:
            status = ask_rig(scan_id)
        except UnknownScanError:
            status = self._command_settled(scan_id, ask_rig, without_rig)
        self._refresh(scan_id)
        self._bell.ring()
        return status

    def _command_settled(
        self,
        scan_id: str,
        ask_rig: Callable[[str], ScanStatus],
        without_rig: Callable[[ScanRecord], ScanStatus],
    ) -> ScanStatus:
        """Ask once more when no start is under way: the rig may only just be learning of it."""
        with self._starting:
            record = self._require_unfinished(scan_id)
            try:
                return ask_rig(scan_id)
            except UnknownScanError:
                status = without_rig(record)
                self.catalogue.update(status)
                return status

    def _require_arm(self, scan_id: str) -> None:
        if self.record(scan_id).kind is ScanKind.REPLAY:
            raise NotForReplaysError(f"scan {scan_id} is a replay: cancel it, or let it be")

    def _require_unfinished(self, scan_id: str) -> ScanRecord:
        record = self.record(scan_id)
        state = self.status_of(record).state
        if state in FINISHED:
            raise ScanOverError(f"scan {scan_id} is {state.value}; start a new one")
        return record

    def _refresh(self, scan_id: str, *, at_its_end: bool = False) -> ScanStatus:
        """Note where a scan is; the lock keeps an older answer from overwriting a newer one.

        That it cannot be noted does not undo what the arm has done, so it is no error; but of its
        end nothing else will tell.
        """
        with self._refreshing:
            try:
                status = self._rig.status(scan_id)
            except UnknownScanError:
                return self.record(scan_id).status
            try:
                self.catalogue.update(status, self._recording_path(scan_id))
            except OperationalError:
                if at_its_end:
                    raise
                logger.exception("status not noted scan_id=%s", scan_id)
        return status

    def _recording_path(self, scan_id: str) -> Path | None:
        try:
            return self._rig.recording_path(scan_id)
        except UnknownScanError:
            return None

    def _catch_up(self, interrupted: Collection[str]) -> None:
        """Look through many scans and skeletons: beside the service, which answers meanwhile."""
        for spec in incomplete(self.catalogue, interrupted):
            if self._closing.is_set():
                return
            self.replays.feed(spec)

    def _catch_up_journal(self) -> None:
        """Wait until what the rig has told so far is noted, but not for long."""
        noted = Event()
        self._events.put(noted)
        if not noted.wait(_JOURNAL_TIMEOUT_S):
            logger.warning("the journal lags behind; a stop may need another acknowledgement")

    def _write_journal(self) -> None:
        while (event := self._events.get()) is not None:
            if isinstance(event, Event):
                event.set()
                continue
            try:
                self._note(event)
            except Exception:
                # The recording holds the event too; the next ones must still be noted.
                logger.exception("event not noted kind=%s scan_id=%s", event.kind, event.scan_id)
                self.replays.tell_again(event)
            self._bell.ring()

    def _note(self, event: RigEvent) -> None:
        """Note event, status and skeleton; the skeleton first, so that who is told finds it.

        A skeleton that a newer one has replaced by now is not kept.
        """
        record = self.catalogue.scan(event.scan_id)
        if record is None:
            logger.info("event of no scan kind=%s fields=%s", event.kind, dict(event.fields))
            return
        # Noted apart from the scan, which may be cancelled by then. Without a detail it is what
        # comes of an operator's stop: `stop` has noted that, and it may be acknowledged by now.
        if event.kind in _HOLDING and event.fields.get("detail"):
            self.catalogue.add_stop()
        skeleton = self._rig.skeleton(event.scan_id)
        if skeleton is not None:
            self.catalogue.add_revision(event.scan_id, skeleton)
        if record.kind is ScanKind.REPLAY:
            status = self.replays.after(event)
        else:
            status = self._refresh(event.scan_id, at_its_end=event.kind in FINISHED)
        self._add_event(status, event.kind, event.fields)

    def _add_event(self, status: ScanStatus, kind: str, fields: Mapping[str, object]) -> None:
        data = status_fields(status) | {
            "at": datetime.now(UTC).isoformat(timespec="milliseconds"),
            "fields": json.loads(json.dumps(dict(fields), default=str)),
        }
        self.catalogue.add_event(status.scan_id, kind, data)
