"""The newest skeleton of each scan, as the workers published it."""

import logging
import threading
from collections import OrderedDict
from collections.abc import Callable

import zenoh

from service.bus import BusError, Keys, scan_id_of
from service.heartbeat import Version, decode_version

SCANS_KEPT = 8
_QUERY_TIMEOUT_S = 2.0
_log = logging.getLogger(__name__)


class SkeletonCache:
    """Keeps the newest document of the last scans.

    `on_skeleton(scan_id, document, version)` is called for every newer one, from zenoh's thread: it
    must return at once.
    """

    def __init__(
        self, session: zenoh.Session, keys: Keys, on_skeleton: Callable[[str, bytes, Version], None]
    ) -> None:
        self._session, self._keys, self._on_skeleton = session, keys, on_skeleton
        self._lock = threading.Lock()
        self._latest: OrderedDict[str, tuple[Version, bytes]] = OrderedDict()
        self._subscriber = session.declare_subscriber(keys.skeletons, self._take)

    def latest(self, scan_id: str) -> bytes | None:
        """Return the newest document (JSON) of a scan; None while there is none."""
        with self._lock:
            return self._latest.get(scan_id, (Version(), None))[1]

    def version(self, scan_id: str) -> Version:
        """Return how much the newest document of a scan knows."""
        with self._lock:
            return self._latest.get(scan_id, (Version(), None))[0]

    def forget(self, scan_id: str) -> None:
        """Drop a scan: it starts anew."""
        with self._lock:
            self._latest.pop(scan_id, None)

    def fetch(self, scan_id: str) -> None:
        """Ask the workers for a document that may have been missed; it comes as if published."""
        self._session.get(self._keys.skeleton(scan_id), self._take_reply, timeout=_QUERY_TIMEOUT_S)

    def _take_reply(self, reply: zenoh.Reply) -> None:
        if reply.ok is not None:
            self._take(reply.ok)

    def _take(self, sample: zenoh.Sample) -> None:
        scan_id = scan_id_of(str(sample.key_expr))
        try:
            version = decode_version(sample.attachment.to_bytes() if sample.attachment else b"")
        except BusError as error:
            _log.warning("%s: %s", sample.key_expr, error)
            return
        data = sample.payload.to_bytes()
        with self._lock:
            known, _ = self._latest.get(scan_id, (Version(), b""))
            if version.order <= known.order:
                return
            self._latest[scan_id] = (version, data)
            self._latest.move_to_end(scan_id)
            if len(self._latest) > SCANS_KEPT:
                self._latest.popitem(last=False)
        self._on_skeleton(scan_id, data, version)
