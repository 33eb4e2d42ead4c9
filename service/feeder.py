"""The service's end of the bus: views out until the worker has them, skeletons back."""

import logging
import threading
import time
from collections.abc import Callable, Sequence
from functools import partial
from types import TracebackType
from typing import Self

import zenoh

from canopy_skel.errors import RecordingError, UsageError
from canopy_skel.messages import Message
from canopy_skel.recording.grouping import Group
from service.bus import Keys
from service.envelope import ViewEnvelope, encode_envelope
from service.heartbeat import Version
from service.offered import Lacking, Listing, OfferedScan, OfferedView, ScanSource
from service.rig import PartStatus
from service.skeleton_cache import SkeletonCache
from service.worker_watch import WorkerSeen, WorkerWatch

IN_FLIGHT = 8
"""Views on their way at a time: what a worker's queue, and this process, hold at most."""
EARLIER_IN_FLIGHT = 2
"""The same of an earlier scan: one in work and one waiting, so that a view of the scan under way
waits for no more than these."""
STOP_TIMEOUT_S = 1.0
_TICK_S = 0.1
_ASK_AGAIN_S = 1.0
_log = logging.getLogger(__name__)


class ViewFeeder:
    """Sends the views of scans to the workers of a rig until they have them.

    A view is sent as it was recorded. It counts as there when a worker's heartbeat lists it, used
    or rejected; it is sent again, from the recording, to a worker that has started since, or that
    has nothing to do and does not have it. All sending and reading happens in a thread of its own;
    an earlier recording, which may be large, is looked through beside it.

    The scan under way comes first: somebody waits beside its tree. Only while the workers have all
    of it, and its skeleton is here, earlier scans are caught up on, one after the other: a worker
    keeps two scans, so it drops neither when a view of the scan under way comes in between.

    Args:
        session: an open bus session.
        keys: of the rig.
        on_skeleton: called with scan id, document (JSON) and version when a newer one has come,
            from a thread of zenoh's; must return at once.
        on_caught_up: called with scan id, number of views and the views that no worker took
            when nothing more is sent of an earlier scan, from the feeder's thread.
    """

    def __init__(
        self,
        session: zenoh.Session,
        keys: Keys,
        on_skeleton: Callable[[str, bytes, Version], None] = lambda *found: None,
        on_caught_up: Callable[[str, int, Sequence[int]], None] = lambda *told: None,
    ) -> None:
        self._session, self._keys, self._on_skeleton = session, keys, on_skeleton
        self._on_caught_up = on_caught_up
        self._changed = threading.Condition()
        self._current: OfferedScan | None = None
        self._earlier: dict[str, OfferedScan] = {}  # in the order they are caught up on
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
        """Turn to a scan; views of the one before that are missing still are sent when it rests.

        Raises:
            UsageError: the scan id cannot be part of a bus key.
        """
        self._keys.view(source.scan_id)
        with self._changed:
            self._put_back(but=source.scan_id)
            self._skeletons.forget(source.scan_id)
            self._earlier.pop(source.scan_id, None)
            self._current = OfferedScan(source=source)
            self._changed.notify_all()

    def catch_up(self, source: ScanSource) -> None:
        """Have all views sent of a scan that has ended before; nothing if it is under way.

        Which views it has is looked up when its turn comes, after the scan under way.

        Raises:
            UsageError: the scan id cannot be part of a bus key.
        """
        self._keys.view(source.scan_id)
        with self._changed:
            if self._current is None or self._current.source.scan_id != source.scan_id:
                scan = OfferedScan(source=source, listing=Listing.DUE)
                self._earlier.setdefault(source.scan_id, scan)
                self._changed.notify_all()

    def leave(self, scan_id: str) -> None:
        """Send nothing more of an earlier scan, and say nothing more of it."""
        with self._changed:
            self._earlier.pop(scan_id, None)

    def offer(self, index: int, messages: Sequence[Message] = ()) -> None:
        """Say that a view of the scan under way is in the recording; returns at once.

        Args:
            index: of the view.
            messages: what RecordingWriter.write_view returned, to spare reading it again.

        Raises:
            UsageError: no scan was begun.
        """
        with self._changed:
            if self._current is None:
                raise UsageError(f"view {index} is of no scan; begin one first")
            views = self._current.views
            held = sum(bool(one.messages) for one in views.values())
            kept = tuple(messages) if held < IN_FLIGHT else ()
            views.setdefault(index, OfferedView(messages=kept))
            self._changed.notify_all()

    def flush(self, timeout_s: float) -> bool:
        """Wait until the scan under way has arrived and its skeleton is here; say whether so.

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
        """Return whether a worker is there and gets on, and is sent anything at all."""
        if not self._thread.is_alive():
            detail = "no view is sent to it any more; restart the service, nothing is lost"
            return PartStatus(name="worker", ready=False, detail=detail)
        return self._watch.status()

    def latest_skeleton(self, scan_id: str) -> bytes | None:
        """Return the newest document (JSON) of one of the last scans; None while there is none."""
        return self._skeletons.latest(scan_id)

    def _notify(self) -> None:
        with self._changed:
            self._changed.notify_all()

    def _came(self, scan_id: str, document: bytes, version: Version) -> None:
        self._on_skeleton(scan_id, document, version)
        self._notify()

    def _complete(self) -> bool:
        scan, workers = self._current, self._watch.workers()
        if scan is None or not workers:
            return False
        beats = (one.heartbeat for one in workers)
        if any(beat.busy and beat.scan_id == scan.source.scan_id for beat in beats):
            return False
        return not self._lacking(scan, workers) and not self._behind(workers)

    def _lacking(self, scan: OfferedScan, workers: Sequence[WorkerSeen]) -> Lacking:
        return scan.lacking(workers, self._skeletons.version(scan.source.scan_id))

    def _is_covered(self, scan: OfferedScan) -> bool:
        return scan.covered_by(self._skeletons.version(scan.source.scan_id))

    def _put_back(self, but: str) -> None:
        """Have the scan under way caught up on later, unless it has all or goes on itself."""
        scan = self._current
        if scan is None or scan.source.scan_id == but or self._is_covered(scan):
            return
        for one in scan.views.values():
            one.messages, one.tries = (), 0
        self._earlier[scan.source.scan_id] = scan

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
        """Step after step; one that fails costs its own work, not that of every later scan."""
        while not self._stopping:
            try:
                self._step()
            except Exception:
                if not self._stopping:
                    _log.exception("a step of the feeder failed; it goes on")
                    time.sleep(_TICK_S)

    def _step(self) -> None:
        with self._changed:
            if self._stopping:
                return
            workers = self._watch.workers()
            step = self._next(workers)
            if step is None:
                self._changed.wait(_TICK_S)
        self._fetch_missed(workers)
        if step is not None:
            step()

    def _fetch_missed(self, workers: Sequence[WorkerSeen]) -> None:
        """Ask for a skeleton that was missed, at most once in a while."""
        scan_id = self._behind(workers)
        now_s = time.monotonic()
        if scan_id is not None and now_s - self._asked_s > _ASK_AGAIN_S:
            self._asked_s = now_s
            self._skeletons.fetch(scan_id)

    def _next(self, workers: Sequence[WorkerSeen]) -> Callable[[], None] | None:
        """Return what to do now, if anything."""
        scan = self._current
        if not workers:
            if scan is not None:
                scan.release()
            return None
        if scan is not None:
            lacking = self._lacking(scan, workers)
            index = scan.next_to_send(lacking, IN_FLIGHT)
            if index is not None:
                return partial(self._send, scan, index)
            if not scan.is_over(lacking):
                return None
        return self._next_of_earlier(workers)

    def _next_of_earlier(self, workers: Sequence[WorkerSeen]) -> Callable[[], None] | None:
        """Return the next step of the first of the earlier scans, of the others when it is over.

        Replays come last.
        """
        scan = min(self._earlier.values(), key=lambda one: one.source.replay, default=None)
        if scan is None:
            return None
        if scan.listing is not Listing.DONE:
            return partial(self._look_through, scan) if scan.listing is Listing.DUE else None
        lacking = {} if self._is_covered(scan) else self._lacking(scan, workers)
        if scan.is_over(lacking):
            return partial(self._finish, scan, sorted(lacking))
        index = scan.next_to_send(lacking, EARLIER_IN_FLIGHT)
        return None if index is None else partial(self._send, scan, index)

    def _look_through(self, scan: OfferedScan) -> None:
        """Have it looked up which views a recording has, while views are sent."""
        scan.listing = Listing.UNDER_WAY
        threading.Thread(target=self._list, args=(scan,), name="view lister", daemon=True).start()

    def _list(self, scan: OfferedScan) -> None:
        """Look up which views a recording has; one that cannot be read has none.

        Whatever happens it ends as looked through: the scans behind it wait for that.
        """
        groups: tuple[Group, ...] = ()
        try:
            groups = scan.recorded.look_through(scan.source.recording()).groups
        except Exception as error:
            foreseen = isinstance(error, RecordingError)
            name = scan.source.scan_id
            _log.warning("scan %s: no view of it is sent: %s", name, error, exc_info=not foreseen)
        with self._changed:
            scan.views = {one.index: OfferedView() for one in groups if not one.partial}
            scan.listing = Listing.DONE
            self._changed.notify_all()

    def _finish(self, scan: OfferedScan, refused: Sequence[int]) -> None:
        """Leave an earlier scan, and let the worker drop that one before the scan under way."""
        scan_id = scan.source.scan_id
        with self._changed:
            if self._earlier.get(scan_id) is not scan:
                return  # it goes on itself
            del self._earlier[scan_id]
            current = self._current
            known = min(current.views, default=None) if current and self._earlier else None
        if refused:
            _log.warning("scan %s: no worker takes views %s; given up", scan_id, refused)
        self._on_caught_up(scan_id, len(scan.views), refused)
        if current is not None and known is not None:
            # A worker keeps the scans it heard of last. The newest view may be one without depth,
            # which cannot be told from one that is still being written.
            self._send(current, known)

    def _send(self, scan: OfferedScan, index: int) -> None:
        source, one = scan.source, scan.views[index]
        try:
            envelope = ViewEnvelope(
                scan_id=source.scan_id,
                view=index,
                config=source.config,
                segmenter=source.segmenter,
                messages=one.messages or _read(scan, index),
            )
            # It may wait for seconds and lose the view even so: hence this thread, and the rest.
            self._session.put(
                self._keys.view(source.scan_id),
                encode_envelope(envelope),
                congestion_control=zenoh.CongestionControl.BLOCK,
            )
        except Exception as error:  # put off, or it would be tried for ever before all others
            foreseen = isinstance(error, (RecordingError, UsageError, zenoh.ZError))
            name = source.scan_id
            _log.warning(
                "scan %s: view %d is not sent yet: %s", name, index, error, exc_info=not foreseen
            )
            scan.recorded.forget()
            one.put_off()
        else:
            one.mark_sent()


def _read(scan: OfferedScan, index: int) -> tuple[Message, ...]:
    try:
        return scan.recorded.messages(scan.source.recording(), index)
    except RecordingError:
        # The scan may just have ended, which renames its recording.
        scan.recorded.forget()
        return scan.recorded.messages(scan.source.recording(), index)
