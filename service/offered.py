"""The views of a scan on their way to the workers: which they lack, which is to be sent now."""

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from enum import Enum, auto
from pathlib import Path

from canopy_skel.messages import Message
from canopy_skel.pipeline import MethodConfig
from service.heartbeat import Version
from service.recorded import RecordedViews
from service.worker_watch import WorkerSeen

MOST_TRIES = 5
"""How often a view is sent before nothing waits for it any more."""
_PATIENCE_S = 1.0
_MAX_PATIENCE_S = 16.0

Lacking = Mapping[int, Sequence[WorkerSeen]]
"""By view the workers that are to get it."""


@dataclass(frozen=True, kw_only=True, slots=True)
class ScanSource:
    """A scan whose views are to be sent.

    recording: returns where the recording is now (`.part` while it grows). replay: nobody waits
    beside a tree for it.
    """

    scan_id: str
    config: MethodConfig
    segmenter: str
    recording: Callable[[], Path]
    replay: bool = False


@dataclass(kw_only=True, slots=True)
class OfferedView:
    """A recorded view on its way to the workers.

    messages: empty where the recording must be asked. sent_s: when it was sent, None = it is to be
    sent, but not before due_s. tries: how often it was lost.
    """

    messages: tuple[Message, ...] = ()
    due_s: float = 0.0
    sent_s: float | None = None
    tries: int = 0

    def mark_sent(self) -> None:
        """Note that it is on its way."""
        self.messages, self.sent_s = (), time.monotonic()

    def put_off(self) -> None:
        """Have it sent later: just now it cannot be."""
        self.messages, self.due_s = (), time.monotonic() + self._patience_s()
        self.tries += 1

    def mark_lost(self, lacking: Sequence[WorkerSeen]) -> None:
        """Have it sent again if a worker has started since, or idles without it."""
        if self.sent_s is None:
            return
        for worker in lacking:
            idle = not worker.heartbeat.busy and worker.last_s - self.sent_s > self._patience_s()
            if idle or worker.first_s > self.sent_s:
                self.sent_s, self.tries = None, self.tries + 1
                return

    def _patience_s(self) -> float:
        return min(_PATIENCE_S * 2.0**self.tries, _MAX_PATIENCE_S)


class Listing(Enum):
    """Whether the views of a recording are known, or are still to be looked up in it."""

    DUE = auto()
    UNDER_WAY = auto()
    DONE = auto()


@dataclass(kw_only=True, eq=False, slots=True)
class OfferedScan:
    """A scan and the views of it that were offered, by index. recorded: where they are read."""

    source: ScanSource
    views: dict[int, OfferedView] = field(default_factory=dict)
    listing: Listing = Listing.DONE
    recorded: RecordedViews = field(default_factory=RecordedViews)

    def covered_by(self, skeleton: Version) -> bool:
        """Whether a skeleton is the last one that the views give."""
        return skeleton.exact and skeleton.revision + skeleton.rejected >= len(self.views)

    def lacking(self, workers: Sequence[WorkerSeen], skeleton: Version) -> Lacking:
        """Return the views that workers lack.

        Where only the skeleton is lacking it is the last view: on getting it again a worker says
        what it has in truth, and makes a skeleton that it could not make before.

        Args:
            workers: those that are there.
            skeleton: how much the newest skeleton of the scan knows.
        """
        scan_id, sha256 = self.source.scan_id, self.source.config.sha256()
        has = [(worker, worker.has(scan_id, sha256)) for worker in workers]
        lacking = {i: [one for one, views in has if i not in views] for i in self.views}
        lacking = {index: workers for index, workers in lacking.items() if workers}
        unusable = not any(worker.has_usable(scan_id, sha256) for worker in workers)
        if lacking or unusable or not self.views or self.covered_by(skeleton):
            return lacking
        return {max(self.views): workers}

    def next_to_send(self, lacking: Lacking, most: int) -> int | None:
        """Return the view to send now, None while there is none or `most` are on their way."""
        now_s = time.monotonic()
        for index, workers in lacking.items():
            self.views[index].mark_lost(workers)
        waiting = [index for index in lacking if self.views[index].sent_s is None]
        if len(lacking) - len(waiting) >= most:
            return None
        return min((i for i in waiting if self.views[i].due_s <= now_s), default=None)

    def is_over(self, lacking: Lacking) -> bool:
        """Whether nothing is lacking but what was tried often enough."""
        return all(self.views[index].tries >= MOST_TRIES for index in lacking)

    def release(self) -> None:
        """Hold no messages; the recording has them."""
        for one in self.views.values():
            one.messages = ()
