"""The catalogue: which scans there were, what happened in them, which skeletons came out.

SQLite beside the recordings; skeleton documents are files, written before the row that names them.
One process owns a catalogue at a time. Every method may be called from any thread.
"""

import fcntl
import json
import os
import sqlite3
import time
from collections.abc import Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import sqlalchemy as sa
from alembic import command
from alembic.config import Config

from canopy_skel.errors import UsageError
from service.outputs import require_writable
from service.rig import FINISHED, ScanKind, ScanState, ScanStatus
from service.tables import EVENTS, IDEMPOTENCY, REVISIONS, SCANS, STOPS

KEY_LIFETIME_NS = 24 * 3600 * 10**9
MOST_NUMBER = 2**63 - 1
"""The largest number it can be asked for."""
INTERRUPTED = (
    "the service ended during this scan; look at the arm, acknowledge, then resume or cancel"
)
_BUSY_TIMEOUT_MS = 5000


@dataclass(frozen=True, kw_only=True, slots=True)
class ScanRecord:
    """A scan or replay as the catalogue knows it. request: see `service.specs.fields_of`."""

    scan_id: str
    tree_id: str
    state: ScanState
    request: Mapping[str, Any]
    views_done: int
    views_total: int
    detail: str
    recording: Path | None
    created_ns: int
    updated_ns: int
    kind: ScanKind

    @property
    def status(self) -> ScanStatus:
        """The part of it that a rig reports."""
        return ScanStatus(**{name: getattr(self, name) for name in ScanStatus.__slots__})


@dataclass(frozen=True, kw_only=True, slots=True)
class EventRecord:
    """An event of a scan; seq counts from 1."""

    seq: int
    kind: str
    data: Mapping[str, Any]


@dataclass(frozen=True, kw_only=True, slots=True)
class RevisionRecord:
    """A skeleton document: its revision number, the hash of its bytes, the file."""

    revision: int
    sha256: str
    path: Path


@dataclass(frozen=True, kw_only=True, slots=True)
class UsedKey:
    """What an idempotency key was used for, and the answer then."""

    body_sha256: str
    scan_id: str
    response: Mapping[str, Any]

    def answer(self, body_sha256: str) -> Mapping[str, Any]:
        """Return that answer to a request with this body.

        Raises:
            KeyReusedError: the key was used for another body.
        """
        if self.body_sha256 != body_sha256:
            raise KeyReusedError(f"this Idempotency-Key was used for scan {self.scan_id}")
        return self.response


class KeyReusedError(Exception):
    """An idempotency key came back with another body."""


class Catalogue:
    """Entering opens (and where needed makes or migrates) the catalogue in `folder`."""

    def __init__(self, folder: str | Path) -> None:
        self._folder = Path(folder)
        self._blobs = self._folder / "skeletons"

    @property
    def uploads(self) -> Path:
        """Folder of what is being received; emptied by `recover`."""
        return self._folder / "uploads"

    def __enter__(self) -> Self:
        """Take the folder for this process and bring the schema up to date.

        Raises:
            UsageError: another process has it open, or it cannot be written.
        """
        require_writable(self._blobs)
        self.uploads.mkdir(exist_ok=True)
        self._lock = _locked(self._folder / "catalogue.lock")
        self._engine = sa.create_engine(f"sqlite:///{self._folder / 'catalogue.sqlite'}")
        sa.event.listen(self._engine, "connect", _set_up)
        sa.event.listen(self._engine, "begin", _begin)
        with self._engine.begin() as connection:
            config = Config()
            config.set_main_option("script_location", "service:migrations")
            config.attributes["connection"] = connection
            command.upgrade(config, "head")
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        """Close every connection and give the folder free."""
        self._engine.dispose()
        os.close(self._lock)

    def transaction(self) -> AbstractContextManager[sa.Connection]:
        """Return a connection whose changes are all kept, or none if the block raises."""
        return self._engine.begin()

    def recover(self) -> list[str]:
        """Put right what a killed service left; return the scans that were under way then.

        They become STOPPED: their motion is over, and only an operator may have it go on. Replays
        go on by themselves.
        """
        moving = SCANS.c.state.in_([ScanState.RUNNING, ScanState.PAUSED])
        under_way = moving & (SCANS.c.kind == ScanKind.SCAN)
        with self.transaction() as connection:
            left = connection.scalars(sa.select(SCANS.c.scan_id).where(under_way)).all()
            connection.execute(
                SCANS.update()
                .where(under_way)
                .values(state=ScanState.STOPPED, detail=INTERRUPTED, updated_ns=time.time_ns())
            )
            named = set()
            for row in connection.execute(sa.select(REVISIONS)).all():
                if (self._folder / row.path).exists():
                    named.add(self._folder / row.path)
                else:
                    connection.execute(
                        REVISIONS.delete().where(_is_revision(row.scan_id, row.revision))
                    )
        uploads = filter(Path.is_file, self.uploads.iterdir())
        for file in (set(self._blobs.iterdir()) - named).union(uploads):
            file.unlink()
        return list(left)

    def add_stop(self) -> None:
        """Note that an operator has stopped the arm."""
        with self.transaction() as connection:
            connection.execute(STOPS.insert().values(stopped_ns=time.time_ns()))

    def last_stop(self) -> int:
        """Return the number of the last stop that nobody has acknowledged, 0 if there is none."""
        with self.transaction() as connection:
            return connection.scalar(sa.select(sa.func.max(STOPS.c.seq))) or 0

    def drop_stops(self, last: int) -> None:
        """Forget the stops up to one: they were acknowledged."""
        with self.transaction() as connection:
            connection.execute(STOPS.delete().where(STOPS.c.seq <= last))

    def add_scan(
        self,
        status: ScanStatus,
        request: Mapping[str, Any],
        key: str | None,
        body_sha256: str,
        response: Mapping[str, Any],
        kind: ScanKind = ScanKind.SCAN,
    ) -> None:
        """Note a scan that is about to start, the key (if any) that asked for it, the answer."""
        now_ns = time.time_ns()
        with self.transaction() as connection:
            connection.execute(
                IDEMPOTENCY.delete().where(IDEMPOTENCY.c.created_ns < now_ns - KEY_LIFETIME_NS)
            )
            connection.execute(
                SCANS.insert().values(
                    **_status_values(status),
                    request=request,
                    created_ns=now_ns,
                    updated_ns=now_ns,
                    kind=kind,
                )
            )
            if key is None:
                return
            connection.execute(
                IDEMPOTENCY.insert().values(
                    key=key,
                    body_sha256=body_sha256,
                    scan_id=status.scan_id,
                    response=response,
                    created_ns=now_ns,
                )
            )

    def drop_scan(self, scan_id: str) -> None:
        """Forget a scan that was refused, and the key that asked for it."""
        with self.transaction() as connection:
            connection.execute(SCANS.delete().where(SCANS.c.scan_id == scan_id))

    def used_key(self, key: str) -> UsedKey | None:
        """Return what the key was used for within the last 24 hours, None if for nothing."""
        fresh = IDEMPOTENCY.c.created_ns >= time.time_ns() - KEY_LIFETIME_NS
        with self.transaction() as connection:
            query = sa.select(IDEMPOTENCY).where(IDEMPOTENCY.c.key == key, fresh)
            row = connection.execute(query).one_or_none()
        if row is None:
            return None
        return UsedKey(body_sha256=row.body_sha256, scan_id=row.scan_id, response=row.response)

    def answer(self, key: str | None, body_sha256: str) -> Mapping[str, Any] | None:
        """Return what a request with this key was answered, None if there was none.

        Raises:
            KeyReusedError: the key was used for another body.
        """
        used = None if key is None else self.used_key(key)
        return None if used is None else used.answer(body_sha256)

    def update(self, status: ScanStatus, recording: Path | None = None) -> None:
        """Note where a scan is now."""
        values = _status_values(status) | {"updated_ns": time.time_ns()}
        if recording is not None:
            values["recording"] = str(recording)
        with self.transaction() as connection:
            connection.execute(
                SCANS.update().where(SCANS.c.scan_id == status.scan_id).values(values)
            )

    def scan(self, scan_id: str) -> ScanRecord | None:
        """Return a scan, None if there is none of this id."""
        with self.transaction() as connection:
            query = sa.select(SCANS).where(SCANS.c.scan_id == scan_id)
            row = connection.execute(query).one_or_none()
        return None if row is None else _scan_record(row)

    def scans(
        self, limit: int, before: str | None = None, kind: ScanKind | None = None
    ) -> list[ScanRecord]:
        """Return up to `limit` scans, newest first: older than scan `before`, of one kind."""
        place = sa.tuple_(SCANS.c.created_ns, SCANS.c.scan_id)
        query = sa.select(SCANS).order_by(SCANS.c.created_ns.desc(), SCANS.c.scan_id.desc())
        if before is not None:
            mark = sa.select(SCANS.c.created_ns, SCANS.c.scan_id).where(SCANS.c.scan_id == before)
            query = query.where(place < mark.scalar_subquery())
        if kind is not None:
            query = query.where(SCANS.c.kind == kind)
        with self.transaction() as connection:
            return [_scan_record(row) for row in connection.execute(query.limit(limit))]

    def count_scans(self, kind: ScanKind) -> dict[str, int]:
        """Return how many scans, or replays, are in each state."""
        return self._counts(SCANS.c.state, SCANS.c.kind == kind)

    def count_events(self) -> dict[str, int]:
        """Return how many events of each kind there were."""
        return self._counts(EVENTS.c.kind, sa.true())

    def _counts(self, column: sa.Column[str], of: sa.ColumnElement[bool]) -> dict[str, int]:
        query = sa.select(column, sa.func.count()).where(of).group_by(column)
        with self.transaction() as connection:
            rows = connection.execute(query)
            return {str(row[0]): int(row[1]) for row in rows}

    def unfinished(self, kind: ScanKind = ScanKind.SCAN) -> list[ScanRecord]:
        """Return the scans, or replays, that can still go on, newest first."""
        going = SCANS.c.state.not_in(FINISHED) & (SCANS.c.kind == kind)
        query = sa.select(SCANS).where(going)
        with self.transaction() as connection:
            rows = connection.execute(query.order_by(SCANS.c.created_ns.desc()))
            return [_scan_record(row) for row in rows]

    def add_event(self, scan_id: str, kind: str, data: Mapping[str, Any]) -> None:
        """Append an event to a scan's."""
        last = sa.select(sa.func.coalesce(sa.func.max(EVENTS.c.seq), 0) + 1).where(
            EVENTS.c.scan_id == scan_id
        )
        with self.transaction() as connection:
            connection.execute(
                EVENTS.insert().values(
                    scan_id=scan_id, seq=last.scalar_subquery(), kind=kind, data=data
                )
            )

    def events(self, scan_id: str, after: int) -> list[EventRecord]:
        """Return the events of a scan with seq above `after`, in order."""
        query = sa.select(EVENTS).where(EVENTS.c.scan_id == scan_id, EVENTS.c.seq > after)
        with self.transaction() as connection:
            rows = connection.execute(query.order_by(EVENTS.c.seq))
            return [EventRecord(seq=row.seq, kind=row.kind, data=row.data) for row in rows]

    def add_revision(self, scan_id: str, content: bytes) -> bool:
        """Keep a skeleton document and say whether it is news.

        Revisions never go back: one older than the newest is ignored, so all but the newest are
        final.
        """
        digest = sha256(content).hexdigest()
        newest = self.newest_revision(scan_id)
        if newest and digest == newest.sha256:
            return False
        revision = json.loads(content)["revision"]
        if newest and revision < newest.revision:
            return False
        path = self._blobs / f"{digest}.json"
        _write_durably(path, content)
        values = {"sha256": digest, "path": str(path.relative_to(self._folder))}
        place = {"scan_id": scan_id, "revision": revision}
        with self.transaction() as connection:
            connection.execute(REVISIONS.delete().where(_is_revision(scan_id, revision)))
            connection.execute(REVISIONS.insert().values(place | values))
        return True

    def newest_revision(self, scan_id: str) -> RevisionRecord | None:
        """Return the newest skeleton revision of a scan, None while there is none."""
        query = sa.select(REVISIONS).where(REVISIONS.c.scan_id == scan_id)
        return self._revision(query.order_by(REVISIONS.c.revision.desc()).limit(1))

    def revision(self, scan_id: str, revision: int) -> RevisionRecord | None:
        """Return one skeleton revision of a scan, None if it is not there."""
        return self._revision(sa.select(REVISIONS).where(_is_revision(scan_id, revision)))

    def _revision(self, query: sa.Select[Any]) -> RevisionRecord | None:
        with self.transaction() as connection:
            row = connection.execute(query).one_or_none()
        if row is None:
            return None
        path = self._folder / row.path
        return RevisionRecord(revision=row.revision, sha256=row.sha256, path=path)


def _locked(path: Path) -> int:
    descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        os.close(descriptor)
        raise UsageError(
            f"{path.parent}: another canopy service uses this folder; end it or name another one"
        ) from error
    return descriptor


def _begin(connection: sa.Connection) -> None:
    connection.exec_driver_sql("BEGIN")


def _set_up(connection: sqlite3.Connection, record: object) -> None:
    # By itself the driver begins no transaction before a change of tables: what is killed in a
    # migration would have half of it.
    connection.isolation_level = None
    cursor = connection.cursor()
    for pragma in (
        "journal_mode=WAL",
        "synchronous=FULL",  # with NORMAL a power cut loses what was noted last
        "foreign_keys=ON",
        f"busy_timeout={_BUSY_TIMEOUT_MS}",
    ):
        cursor.execute(f"PRAGMA {pragma}")
    cursor.close()


def _write_durably(path: Path, content: bytes) -> None:
    part = path.with_suffix(".part")
    with part.open("wb") as stream:
        stream.write(content)
        stream.flush()
        os.fsync(stream.fileno())
    part.replace(path)


def _is_revision(scan_id: str, revision: int) -> sa.ColumnElement[bool]:
    return sa.and_(REVISIONS.c.scan_id == scan_id, REVISIONS.c.revision == revision)


def _status_values(status: ScanStatus) -> dict[str, Any]:
    return {name: getattr(status, name) for name in ScanStatus.__slots__}


def _scan_record(row: sa.Row[Any]) -> ScanRecord:
    fields = dict(row._mapping)  # noqa: SLF001  # SQLAlchemy's public name for it
    recording = fields.pop("recording")
    fields["state"], fields["kind"] = ScanState(fields["state"]), ScanKind(fields["kind"])
    return ScanRecord(**fields, recording=Path(recording) if recording else None)
