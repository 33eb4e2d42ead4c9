import signal
import subprocess
import sys
from contextlib import suppress
from pathlib import Path

import pytest
import sqlalchemy as sa
from alembic.autogenerate import compare_metadata
from alembic.migration import MigrationContext
from live_service import skeleton

from canopy_skel.errors import UsageError
from service import catalogue as catalogue_module
from service.catalogue import INTERRUPTED, Catalogue
from service.rig import ScanKind, ScanState, ScanStatus
from service.tables import METADATA

ROOT = Path(__file__).parents[2]


def status(scan_id="s1", state=ScanState.RUNNING, **changes):
    fields = {"tree_id": "t", "views_done": 0, "views_total": 3} | changes
    return ScanStatus(scan_id=scan_id, state=state, **fields)


@pytest.fixture
def catalogue(tmp_path):
    with Catalogue(tmp_path) as catalogue:
        yield catalogue


def test_the_migrations_make_the_tables_of_the_code(catalogue):
    with catalogue.transaction() as connection:
        context = MigrationContext.configure(connection)
        assert compare_metadata(context, METADATA) == []


def test_sqlite_is_set_up_for_a_service(catalogue):
    with catalogue.transaction() as connection:
        values = [
            connection.scalar(sa.text(f"PRAGMA {name}"))
            for name in ("journal_mode", "synchronous", "foreign_keys", "busy_timeout")
        ]
    assert values == ["wal", 2, 1, 5000]  # 2: what was noted is on disk, whatever happens then


def test_a_catalogue_has_one_owner(tmp_path, catalogue):
    with pytest.raises(UsageError, match="another canopy service"), Catalogue(tmp_path):
        pass


def test_a_folder_that_cannot_be_made_is_named(tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(UsageError, match="file"), Catalogue(tmp_path / "file/state"):
        pass


def test_an_old_catalogue_opens_again(tmp_path):
    with Catalogue(tmp_path) as catalogue:
        catalogue.add_scan(status(), {"a": [0.1]}, "k", "sha", {})
    with Catalogue(tmp_path) as catalogue:
        record = catalogue.scan("s1")
    assert (record.status, record.request) == (status(), {"a": [0.1]})


def test_a_catalogue_of_an_earlier_version_is_brought_up_to_date(tmp_path):
    with Catalogue(tmp_path) as catalogue:
        catalogue.add_scan(status(), {}, "k", "sha", {})
        with catalogue.transaction() as connection:
            catalogue_at_first(connection)
    with Catalogue(tmp_path) as catalogue:
        assert catalogue.scan("s1").kind is ScanKind.SCAN
        assert catalogue.last_stop() == 0
        catalogue.add_stop()
        assert catalogue.last_stop() == 1


def test_a_change_of_tables_is_whole_or_none(catalogue):
    with suppress(ZeroDivisionError), catalogue.transaction() as connection:
        connection.execute(sa.text("ALTER TABLE scans ADD COLUMN half INTEGER"))
        connection.execute(sa.text("DROP TABLE stops"))
        raise ZeroDivisionError
    assert catalogue.last_stop() == 0
    test_the_migrations_make_the_tables_of_the_code(catalogue)


def catalogue_at_first(connection):
    """Undo what later versions have changed."""
    connection.execute(sa.text("DROP TABLE stops"))
    connection.execute(sa.text("ALTER TABLE scans DROP COLUMN kind"))
    connection.execute(sa.text("UPDATE alembic_version SET version_num = '0001'"))


def test_a_refused_scan_is_forgotten_with_its_key(catalogue):
    catalogue.add_scan(status(), {}, "k", "sha", {})
    catalogue.add_event("s1", "started", {})
    catalogue.drop_scan("s1")
    assert catalogue.scan("s1") is None
    assert catalogue.used_key("k") is None
    assert catalogue.events("s1", 0) == []


def test_a_key_is_free_after_a_day(catalogue, monkeypatch):
    catalogue.add_scan(status("s1"), {}, "k", "sha", {})
    assert catalogue.used_key("k").scan_id == "s1"
    now_ns = catalogue_module.time.time_ns()
    monkeypatch.setattr(
        catalogue_module.time, "time_ns", lambda: now_ns + catalogue_module.KEY_LIFETIME_NS + 10**9
    )
    assert catalogue.used_key("k") is None
    catalogue.add_scan(status("s2"), {}, "k", "other", {})
    assert catalogue.used_key("k").scan_id == "s2"


def test_recovery_stops_what_was_under_way_and_nothing_else(catalogue):
    states = list(ScanState)
    for state in states:
        catalogue.add_scan(status(state.value, state), {}, f"k-{state}", "sha", {})
    assert sorted(catalogue.recover()) == ["paused", "running"]
    for state in states:
        record = catalogue.scan(state.value)
        under_way = state in (ScanState.RUNNING, ScanState.PAUSED)
        assert record.state is (ScanState.STOPPED if under_way else state)
        assert record.detail == (INTERRUPTED if under_way else "")


def test_recovery_makes_revisions_and_files_agree(tmp_path, catalogue):
    catalogue.add_scan(status(), {}, "k", "sha", {})
    for revision in (1, 2):
        assert catalogue.add_revision("s1", skeleton("s1", revision, length_m=revision))
    catalogue.newest_revision("s1").path.unlink()
    stray = tmp_path / "skeletons/abc.part"
    stray.touch()
    catalogue.recover()
    assert catalogue.newest_revision("s1").revision == 1
    assert not stray.exists()
    assert catalogue.newest_revision("s1").path.read_bytes() == skeleton("s1", 1, length_m=1)


SCAN_FOREVER = """
import sys
sys.path[:0] = sys.argv[2:]
from live_service import skeleton
from test_catalogue import status
from service.catalogue import Catalogue

with Catalogue(sys.argv[1]) as catalogue:
    catalogue.add_scan(status(), {"a": 1}, "k", "sha", {})
    for revision in range(1, 100000):
        document = skeleton("s1", revision, length_m=revision)
        catalogue.add_revision("s1", document)
        catalogue.update(status(views_done=revision))
        catalogue.add_event("s1", "skeleton", {"revision": revision})
        print(revision, flush=True)
"""


def test_a_catalogue_is_whole_after_its_service_was_killed(tmp_path):
    arguments = [sys.executable, "-c", SCAN_FOREVER, tmp_path, ROOT, ROOT / "tests/service"]
    with subprocess.Popen(arguments, stdout=subprocess.PIPE, text=True) as process:
        told = [int(process.stdout.readline()) for _ in range(20)]
        process.send_signal(signal.SIGKILL)
        told += [int(line) for line in process.stdout if line.endswith("\n")]
    assert process.returncode == -signal.SIGKILL
    with Catalogue(tmp_path) as catalogue:
        assert catalogue.recover() == ["s1"]
        record = catalogue.scan("s1")
        assert (record.state, record.detail) == (ScanState.STOPPED, INTERRUPTED)
        assert record.views_done >= told[-1]
        assert [e.data["revision"] for e in catalogue.events("s1", 0)][: len(told)] == told
        for revision in told:
            content = catalogue.revision("s1", revision).path.read_bytes()
            assert content == skeleton("s1", revision, length_m=revision)
        with catalogue.transaction() as connection:
            assert connection.scalar(sa.text("PRAGMA integrity_check")) == "ok"
