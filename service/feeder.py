"""The service's end of the bus: views out until the worker has them, skeletons back."""

import logging
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Self

import zenoh

from canopy_skel.errors import RecordingError, UsageError
from canopy_skel.messages import Message
from canopy_skel.pipeline import MethodConfig
from canopy_skel.recording import Recording, messages_of_view, read_recording
from service.bus import Keys
from service.envelope import ViewEnvelope, encode_envelope
from service.rig import PartStatus
from service.skeleton_cache import SkeletonCache
from service.worker_watch import WorkerSeen, WorkerWatch

IN_FLIGHT = 8
"""Views on their way at a time: what a worker's queue, and this process, hold at most."""
STOP_TIMEOUT_S = 1.0
_TICK_S = 0.1
_PATIENCE_S = 1.0
_MAX_PATIENCE_S = 16.0
_log = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True, slots=True)
class ScanSource:
    """A scan whose views are to be sent.

    recording: returns where the recording is now (`.part` while it grows).
    """

    scan_id: str
    config: MethodConfig
    segmenter: str
    recording: Callable[[], Path]


@dataclass(kw_only=True, slots=True)
class _Offered:
    """A recorded view on its way to the worker.

    messages: empty where the recording must be asked. sent_s: when it was sent, None = it is to be
    sent, but not before due_s. tries: how often it was lost.
    """

    messages: tuple[Message, ...]
    due_s: float = 0.0
    sent_s: float | None = None
    tries: int = 0

    def patience_s(self) -> float:
        """How long to wait before trying again."""
        return min(_PATIENCE_S * 2.0**self.tries, _MAX_PATIENCE_S)


class ViewFeeder:
    """Sends the views of the scan under way to the workers of a rig until they have them.

    A view is sent as it was recorded. It counts as there when a worker's heartbeat lists it, used
    or rejected; it is sent again, from the recording, to a worker that has started since, or that
    has nothing to do and does not have it. All sending and reading happens in a thread of its own.

    Args:
        session: an open bus session.
        keys: of the rig.
        on_skeleton: called with scan id and document (JSON) when a newer one has come, from a
            thread of zenoh's; must return at once.
    """

    def __init__(
        self,
        session: zenoh.Session,
        keys: Keys,
        on_skeleton: Callable[[str, bytes], None] = lambda scan_id, document: None,
    ) -> None:
        self._session, self._keys, self._on_skeleton = session, keys, on_skeleton
        self._changed = threading.Condition()
        self._source: ScanSource | None = None
        self._offered: dict[int, _Offered] = {}
        self._recording: Recording | None = None  # the thread's alone
        self._asked_s = 0.0
        self._stopping = False
        self._thread = threading.Thread(target=self._run, name="view feeder", daemon=True)

    def __enter__(self) -> Self:
        """Listen to the workers and start to send."""
        self._watch = WorkerWatch(self._session, self._keys, self._notify)
        self._skeletons = SkeletonCache(self._session, self._keys, self._came)
        self._thread.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Stop sending, within STOP_TIMEOUT_S; what was not sent is in the recording."""
        with self._changed:
            self._stopping = True
            self._changed.notify_all()
        self._thread.join(STOP_TIMEOUT_S)

    def begin(self, source: ScanSource) -> None:
        """Turn to a scan; views of the one before that are missing still are sent no more.

        Raises:
            UsageError: the scan id cannot be part of a bus key.
        """
        self._keys.view(source.scan_id)
        self._skeletons.forget(source.scan_id)
        with self._changed:
            self._source, self._offered = source, {}
            self._changed.notify_all()

    def offer(self, index: int, messages: Sequence[Message] = ()) -> None:
        """Say that a view of the scan is in the recording; returns at once.

        Args:
            index: of the view.
            messages: what RecordingWriter.write_view returned, to spare reading it again.

        Raises:
            UsageError: no scan was begun.
        """
        with self._changed:
            if self._source is None:
                raise UsageError(f"view {index} is of no scan; begin one first")
            held = sum(bool(one.messages) for one in self._offered.values())
            kept = tuple(messages) if held < IN_FLIGHT else ()
            self._offered.setdefault(index, _Offered(messages=kept))
            self._changed.notify_all()

    def flush(self, timeout_s: float) -> bool:
        """Wait until every offered view has arrived and its skeleton is here; say whether so.

        Without a worker there is nothing to wait for.
        """
        until_s = time.monotonic() + timeout_s
        with self._changed:
            while not self._complete():
                if not self._watch.workers() or time.monotonic() > until_s:
                    return False
                self._changed.wait(_TICK_S)
        return True

    def workers(self) -> tuple[WorkerSeen, ...]:
        """Return the workers that are there now, as they last reported."""
        return self._watch.workers()

    def worker_status(self) -> PartStatus:
        """Return whether a worker is there and gets on."""
        return self._watch.status()

    def latest_skeleton(self, scan_id: str) -> bytes | None:
        """Return the newest document (JSON) of one of the last scans; None while there is none."""
        return self._skeletons.latest(scan_id)

    def _notify(self) -> None:
        with self._changed:
            self._changed.notify_all()

    def _came(self, scan_id: str, document: bytes) -> None:
        self._on_skeleton(scan_id, document)
        self._notify()

    def _complete(self) -> bool:
        workers = self._watch.workers()
        source = self._source
        if source is None or not workers or any(one.heartbeat.busy for one in workers):
            return False
        return not self._missing(source, workers) and not self._behind(workers)

    def _missing(
        self, source: ScanSource, workers: Sequence[WorkerSeen]
    ) -> dict[int, list[WorkerSeen]]:
        """Return by view the workers that lack it; views that all have are left out."""
        sha256 = source.config.sha256()
        has = [(worker, worker.has(source.scan_id, sha256)) for worker in workers]
        lacking = {i: [one for one, views in has if i not in views] for i in self._offered}
        return {index: workers for index, workers in lacking.items() if workers}

    def _behind(self, workers: Sequence[WorkerSeen]) -> str | None:
        """Return a scan of whose skeleton an idle worker has a newer version."""
        for beat in (one.heartbeat for one in workers):
            order = (beat.revision, len(beat.rejected), True)
            if (
                not beat.busy
                and beat.revision
                and order > self._skeletons.version(beat.scan_id).order
            ):
                return beat.scan_id
        return None

    def _run(self) -> None:
        while True:
            with self._changed:
                if self._stopping:
                    return
                workers = self._watch.workers()
                source, index = self._source, self._next(workers)
                one = None if index is None else self._offered[index]
                if one is None:
                    self._changed.wait(_TICK_S)
            self._catch_up(workers)
            if source is not None and index is not None and one is not None:
                self._send(source, index, one)

    def _catch_up(self, workers: Sequence[WorkerSeen]) -> None:
        """Ask for a skeleton that was missed, at most once in a while."""
        scan_id = self._behind(workers)
        now_s = time.monotonic()
        if scan_id is not None and now_s - self._asked_s > _PATIENCE_S:
            self._asked_s = now_s
            self._skeletons.fetch(scan_id)

    def _next(self, workers: Sequence[WorkerSeen]) -> int | None:
        """Return the view to send now, if any."""
        if self._source is None:
            return None
        if not workers:
            for one in self._offered.values():
                one.messages = ()  # the recording has them
            return None
        now_s = time.monotonic()
        missing = self._missing(self._source, workers)
        for index, lacking in missing.items():
            self._mark_lost(self._offered[index], lacking)
        on_their_way = sum(self._offered[index].sent_s is not None for index in missing)
        if on_their_way >= IN_FLIGHT:
            return None
        due = (i for i in missing if self._is_due(self._offered[i], now_s))
        return min(due, default=None)

    @staticmethod
    def _is_due(one: _Offered, now_s: float) -> bool:
        return one.sent_s is None and one.due_s <= now_s

    @staticmethod
    def _mark_lost(one: _Offered, lacking: Sequence[WorkerSeen]) -> None:
        """Have a view sent again if a worker has started since, or idles without it."""
        if one.sent_s is None:
            return
        for worker in lacking:
            if worker.first_s > one.sent_s:
                one.sent_s, one.tries = None, 0
                return
            if not worker.heartbeat.busy and worker.last_s - one.sent_s > one.patience_s():
                one.sent_s, one.tries = None, one.tries + 1
                return

    def _send(self, source: ScanSource, index: int, one: _Offered) -> None:
        try:
            envelope = ViewEnvelope(
                scan_id=source.scan_id,
                view=index,
                config=source.config,
                segmenter=source.segmenter,
                messages=one.messages or self._recorded(source, index),
            )
            # It may wait for seconds and lose the view even so: hence this thread, and the rest.
            self._session.put(
                self._keys.view(source.scan_id),
                encode_envelope(envelope),
                congestion_control=zenoh.CongestionControl.BLOCK,
            )
            one.sent_s = time.monotonic()
        except (RecordingError, UsageError, zenoh.ZError) as error:
            _log.warning("scan %s: view %d is not sent yet: %s", source.scan_id, index, error)
            self._recording = None
            one.due_s, one.tries = time.monotonic() + one.patience_s(), one.tries + 1
        one.messages = ()

    def _recorded(self, source: ScanSource, index: int) -> tuple[Message, ...]:
        """Read a view from the recording, which is looked through anew only if need be."""
        try:
            return self._read(source.recording(), index)
        except RecordingError:
            # The scan may just have ended, which renames its recording.
            return self._read(source.recording(), index)

    def _read(self, path: Path, index: int) -> tuple[Message, ...]:
        known = self._recording
        if known is None or known.path != path or index not in {g.index for g in known.groups}:
            known = self._recording = read_recording(path)
        return messages_of_view(known, index)
