"""The bus: zenoh sessions that never leave the loopback, and the table of its keys."""

import json
import logging
import re
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import zenoh

from canopy_skel.errors import CanopyError, UsageError

ENCODING_JSON = "application/json"
ENCODING_PROBLEM = "application/problem+json"
CLOSE_TIMEOUT_S = 0.5
_LEASE_MS = 2000
_ENDPOINT = re.compile(r"tcp/(127\.\d{1,3}\.\d{1,3}\.\d{1,3}|\[::1\]):\d{1,5}")
_CHUNK = re.compile(r"[^/*$#?\s\x00-\x1f]+")
_log = logging.getLogger(__name__)


class BusError(CanopyError):
    """The bus cannot be opened, or what came over it cannot be read."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Keys:
    """The keys of one rig.

    Raises:
        UsageError: a name cannot be part of a key.
    """

    site: str
    rig: str

    def __post_init__(self) -> None:
        """Check the names once."""
        key_part(self.site, "site")
        key_part(self.rig, "rig")

    def view(self, scan_id: str) -> str:
        """One sample per view of a scan: an envelope."""
        return self._scan(scan_id, "view")

    def pose(self, scan_id: str) -> str:
        """The live pose of the arm."""
        return self._scan(scan_id, "pose")

    def event(self, scan_id: str) -> str:
        """What happens in a scan."""
        return self._scan(scan_id, "event")

    def skeleton(self, scan_id: str) -> str:
        """The document of each revision; a query here is answered with the latest."""
        return self._scan(scan_id, "skeleton")

    def worker(self, worker_id: str) -> str:
        """A worker's liveliness and its heartbeat."""
        return f"{self._root}/worker/{key_part(worker_id, 'worker id')}"

    @property
    def views(self) -> str:
        """The views of every scan."""
        return f"{self._root}/scan/*/view"

    @property
    def skeletons(self) -> str:
        """The skeletons of every scan."""
        return f"{self._root}/scan/*/skeleton"

    @property
    def workers(self) -> str:
        """Every worker."""
        return f"{self._root}/worker/*"

    @property
    def _root(self) -> str:
        return f"canopy/v1/{self.site}/{self.rig}"

    def _scan(self, scan_id: str, name: str) -> str:
        return f"{self._root}/scan/{key_part(scan_id, 'scan id')}/{name}"


def key_part(name: str, what: str) -> str:
    """Return the name if it can be one part of a key.

    Raises:
        UsageError: it cannot.
    """
    if not _CHUNK.fullmatch(name):
        raise UsageError(
            f"{what} {name!r} cannot be part of a bus key; use letters, digits, dots and hyphens"
        )
    return name


def scan_id_of(key: str) -> str:
    """Return the scan id in a key of the table that has one."""
    return key.split("/")[5]


@contextmanager
def open_session(
    *, listen: str | None = None, connect: str | None = None
) -> Iterator[zenoh.Session]:
    """Open a session that listens on one endpoint, or connects to one; nothing is scouted for.

    A session that connects may be opened first: it goes on trying until somebody listens, and again
    after the link was lost. On leaving, the session is closed within CLOSE_TIMEOUT_S or left to
    itself: zenoh's own close can wait for a dead peer for many seconds.

    Args:
        listen: endpoint on the loopback to listen on, such as "tcp/127.0.0.1:7447".
        connect: endpoint on the loopback where another session listens.

    Raises:
        UsageError: an endpoint is not on the loopback.
        BusError: the session cannot be opened, for example because the port is taken.
    """
    config = zenoh.Config()
    for key, value in _settings(_checked(listen), _checked(connect)).items():
        config.insert_json5(key, json.dumps(value))
    try:
        session = zenoh.open(config)
    except zenoh.ZError as error:
        where = listen or connect
        raise BusError(
            f"{where}: the bus cannot be opened ({error}); choose a free port"
        ) from error
    try:
        yield session
    finally:
        closing = threading.Thread(target=_close, args=(session,), daemon=True)
        closing.start()
        closing.join(CLOSE_TIMEOUT_S)
        if closing.is_alive():
            _log.warning("the bus session did not close in %s s; left to itself", CLOSE_TIMEOUT_S)


def _settings(listen: list[str], connect: list[str]) -> dict[str, object]:
    """Return every setting whose default would leave the loopback, or wait too long."""
    return {
        "mode": "peer",
        "listen/endpoints": listen,
        "connect/endpoints": connect,
        "connect/retry": {
            "period_init_ms": 200,
            "period_max_ms": 1000,
            "period_increase_factor": 2,
        },
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "transport/shared_memory/enabled": False,
        "transport/link/tx/lease": _LEASE_MS,
    }


def _checked(endpoint: str | None) -> list[str]:
    if endpoint is None:
        return []
    if not _ENDPOINT.fullmatch(endpoint):
        raise UsageError(
            f"bus endpoint {endpoint!r} is not on the loopback; give one like tcp/127.0.0.1:7447"
        )
    return [endpoint]


def _close(session: zenoh.Session) -> None:
    try:
        session.close()
    except zenoh.ZError as error:
        _log.warning("the bus session did not close cleanly: %s", error)
