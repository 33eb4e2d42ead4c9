"""Which workers are there, by their heartbeats."""

import logging
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass

import zenoh

from service.bus import BusError, Keys
from service.heartbeat import SCANS_KEPT, Heartbeat, decode_heartbeat
from service.rig import PartStatus

STALE_S = 2.0
STUCK_S = 120.0
_log = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True, slots=True)
class WorkerSeen:
    """The last heartbeat of a worker process; times are of the monotonic clock.

    scans: the last heartbeat on each of the scans it keeps, the one it worked on last at the end.
    first_s, last_s: its first and last heartbeat. moved_s: when it was idle or made progress last.
    """

    heartbeat: Heartbeat
    scans: tuple[Heartbeat, ...]
    first_s: float
    last_s: float
    moved_s: float

    def has(self, scan_id: str, config_sha256: str) -> frozenset[int]:
        """Return the views of a scan that the worker has used or rejected."""
        return frozenset(
            view
            for beat in self._on(scan_id, config_sha256)
            for view in (*beat.views, *beat.rejected)
        )

    def has_usable(self, scan_id: str, config_sha256: str) -> bool:
        """Return whether the worker has used a view of a scan."""
        return any(beat.views for beat in self._on(scan_id, config_sha256))

    def _on(self, scan_id: str, config_sha256: str) -> list[Heartbeat]:
        wanted = (scan_id, config_sha256)
        return [one for one in self.scans if (one.scan_id, one.config_sha256) == wanted]


class WorkerWatch:
    """Hears the workers of a rig; `on_change` is called on every heartbeat, from zenoh's thread."""

    def __init__(
        self, session: zenoh.Session, keys: Keys, on_change: Callable[[], None] = lambda: None
    ) -> None:
        self._on_change = on_change
        self._lock = threading.Lock()
        self._seen: dict[tuple[str, int], WorkerSeen] = {}
        self._last: WorkerSeen | None = None
        self._subscriber = session.declare_subscriber(keys.workers, self._hear)
        self._liveliness = session.liveliness().declare_subscriber(keys.workers, self._lose)

    def workers(self) -> tuple[WorkerSeen, ...]:
        """Return the workers that were heard within STALE_S."""
        now_s = time.monotonic()
        with self._lock:
            return tuple(one for one in self._seen.values() if now_s - one.last_s < STALE_S)

    def status(self) -> PartStatus:
        """Return whether a worker can be used; the detail says what to mend."""
        workers = self.workers()
        now_s = time.monotonic()
        if not workers:
            return PartStatus(name="worker", ready=False, detail=self._absence(now_s))
        for one in workers:
            if now_s - one.moved_s > STUCK_S:
                detail = (
                    f"worker {one.heartbeat.id} (process {one.heartbeat.pid}) makes no progress"
                    f" for {now_s - one.moved_s:.0f} s; restart it, nothing is lost"
                )
                return PartStatus(name="worker", ready=False, detail=detail)
        problems = (one.heartbeat.problem for one in workers)
        return PartStatus(name="worker", ready=True, detail="; ".join(filter(None, problems)))

    def _absence(self, now_s: float) -> str:
        with self._lock:
            last = self._last
        if last is None:
            return "no worker has reported yet; start one (views are kept in the recording)"
        return (
            f"worker {last.heartbeat.id} (process {last.heartbeat.pid}) is silent for"
            f" {now_s - last.last_s:.1f} s; restart it, nothing is lost"
        )

    def _hear(self, sample: zenoh.Sample) -> None:
        try:
            beat = decode_heartbeat(sample.payload.to_bytes())
        except BusError as error:
            _log.warning("%s: %s", sample.key_expr, error)
            return
        now_s = time.monotonic()
        with self._lock:
            before = self._seen.get((beat.id, beat.pid))
            moving = before is None or not beat.busy or beat.progress != before.heartbeat.progress
            self._last = self._seen[beat.id, beat.pid] = WorkerSeen(
                heartbeat=beat,
                scans=_kept(before.scans if before else (), beat),
                first_s=now_s
                if before is None or now_s - before.last_s > STALE_S
                else before.first_s,
                last_s=now_s,
                moved_s=now_s if before is None or moving else before.moved_s,
            )
        self._on_change()

    def _lose(self, sample: zenoh.Sample) -> None:
        """Forget a worker whose process or link is gone; if it lives, its next heartbeat tells."""
        if sample.kind == zenoh.SampleKind.DELETE:
            worker_id = str(sample.key_expr).rsplit("/", 1)[1]
            with self._lock:
                self._seen = {key: one for key, one in self._seen.items() if key[0] != worker_id}
            self._on_change()


def _kept(before: tuple[Heartbeat, ...], beat: Heartbeat) -> tuple[Heartbeat, ...]:
    """Return what a worker keeps, as it keeps it: the scans it worked on last."""
    if not beat.scan_id:
        return ()
    return (*(one for one in before if one.scan_id != beat.scan_id), beat)[-SCANS_KEPT:]
