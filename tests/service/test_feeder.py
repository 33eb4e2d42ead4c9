"""Scans that the workers do not get while they are under way; what they do get: test_worker."""

import errno
from collections import Counter
from contextlib import suppress
from itertools import pairwise
from threading import Event

import pytest
from scenes.bus import Rig, scan_views, wait_for

from canopy_skel.document import from_json
from canopy_skel.pipeline import MethodConfig
from canopy_skel.recording import RecordingWriter, carry_over
from service.bus import scan_id_of
from service.compose import BusFeed
from service.envelope import decode_envelope
from service.heartbeat import decode_version
from service.recorded import RecordedViews
from service.rig import ScanSpec
from service.scan import set_aside


@pytest.fixture(scope="module")
def views():
    """Ten views; the seventh cannot be used."""
    return scan_views(unusable=(6,))


@pytest.fixture
def rig(tmp_path):
    with Rig(tmp_path) as rig:
        yield rig


def record(rig, views, **changes):
    """Scan: begin, write views and offer them; return the id."""
    with rig.scan(**changes) as writer:
        record_more(rig, writer, views)
    return rig.scan_id


def record_more(rig, writer, views):
    for view in views:
        rig.feeder.offer(view.index, writer.write_view(view))


def wait_for_skeleton(rig, name, timeout_s=30):
    replayed = rig.replayed(name=name)
    wait_for(lambda: rig.feeder.latest_skeleton(name) == replayed, timeout_s)


def test_scans_that_had_no_worker_are_caught_up_on_the_last_one_first(rig, views):
    first = record(rig, views)
    second = record(rig, views[:4])
    last = record(rig, views[:6])
    rig.start_ready_worker()
    assert rig.feeder.flush(20)
    assert {name for name, _ in rig.documents} == {last}
    for name in (first, second):
        wait_for_skeleton(rig, name)
    wait_for(lambda: len(rig.caught_up) == 2)
    assert rig.caught_up == [(first, 10, []), (second, 4, [])]


def test_a_scan_that_is_left_before_the_worker_has_it_all_is_caught_up_on(rig, views):
    rig.start_ready_worker()
    first = record(rig, views)
    second = record(rig, views[:1])
    assert rig.feeder.flush(20)
    for name in (first, second):
        wait_for_skeleton(rig, name)


def test_no_scan_is_begun_twice_when_a_scan_goes_on_while_others_are_caught_up_on(rig, views):
    sent, revisions = Counter(), []

    def count(sample):
        envelope = decode_envelope(sample.payload.to_bytes())
        sent[envelope.scan_id, envelope.view] += 1

    def note(sample):
        version = decode_version(sample.attachment.to_bytes())
        revisions.append((scan_id_of(str(sample.key_expr)), version.revision))

    listeners = [
        rig.session.declare_subscriber(rig.keys.views, count),
        rig.session.declare_subscriber(rig.keys.skeletons, note),
    ]
    earlier = [record(rig, views) for _ in range(3)]
    with rig.scan() as writer:
        rig.start_ready_worker()
        for view in views:
            rig.feeder.offer(view.index, writer.write_view(view))
            assert rig.feeder.flush(20)
            seen = len(revisions)
            wait_for(lambda seen=seen: len(revisions) > seen or len(rig.caught_up) == 3)
    for name in (*earlier, rig.scan_id):
        wait_for_skeleton(rig, name)
    wait_for(lambda: len(rig.caught_up) == 3)
    for name in (*earlier, rig.scan_id):
        assert all(a <= b for a, b in pairwise(n for scan_id, n in revisions if scan_id == name))
    assert all(sent[name, view.index] == 1 for name in earlier for view in views)
    # Beyond its own: one between two earlier scans, that the worker may not drop it.
    assert sum(sent[rig.scan_id, view.index] for view in views) <= len(views) + 2
    del listeners


def test_a_replay_comes_last_and_what_is_left_is_not_sent(rig, views):
    replay = record(rig, views[:3])
    left = record(rig, views[:3])
    scan = record(rig, views[:4])
    rig.feeder.begin(rig.source("under-way"))
    for name in (replay, left):
        rig.feeder.leave(name)
    rig.feeder.catch_up(rig.source(replay, replay=True))
    rig.feeder.catch_up(rig.source(left, replay=True))
    rig.feeder.leave(left)
    rig.start_ready_worker()
    wait_for(lambda: len(rig.caught_up) == 2)
    assert rig.caught_up == [(scan, 4, []), (replay, 3, [])]
    assert rig.feeder.latest_skeleton(replay) == rig.replayed(name=replay)
    assert left not in {name for name, _ in rig.documents}


def test_a_view_goes_out_while_a_large_recording_is_looked_through(rig, views):
    earlier = record(rig, views[:3])
    rig.feeder.begin(rig.source("under-way"))
    rig.feeder.leave(earlier)
    find, looking, looked_through = rig.source(earlier).recording, Event(), Event()

    def found_late():
        looking.set()
        assert looked_through.wait(60)
        return find()

    rig.feeder.catch_up(rig.source(earlier, recording=found_late, replay=True))
    rig.start_ready_worker()
    assert looking.wait(20)
    scan = record(rig, views[:4])
    assert rig.feeder.flush(20)
    assert rig.feeder.latest_skeleton(scan) == rig.replayed()
    assert rig.caught_up == []
    looked_through.set()
    wait_for_skeleton(rig, earlier)


def test_a_worker_killed_while_it_catches_up_is_followed_by_one_that_does(rig, views):
    first = record(rig, views)
    last = record(rig, views[:3])
    worker = rig.start_ready_worker()
    wait_for(lambda: any(name == first for name, _ in rig.documents))
    worker.kill()
    wait_for(lambda: not rig.feeder.worker_status().ready, 5)
    rig.start_ready_worker()
    for name in (first, last):
        wait_for_skeleton(rig, name)


def test_a_scan_that_goes_on_again_is_no_earlier_one_any_more(rig, views):
    first = record(rig, views)
    record(rig, views[:2])
    rig.feeder.begin(rig.source(first))
    for view in views:
        rig.feeder.offer(view.index)
    rig.start_ready_worker()
    assert rig.feeder.flush(20)
    assert rig.feeder.latest_skeleton(first) == rig.replayed(name=first)
    wait_for_skeleton(rig, rig.scan_id)
    wait_for(lambda: rig.caught_up)
    assert rig.caught_up == [(rig.scan_id, 2, [])]


def test_what_was_set_aside_is_caught_up_on_and_not_its_half_copy(rig, views):
    path = rig.folder / "scan.mcap"
    for suffix, some in ((".aside", views), (".part", views[:2])):
        with RecordingWriter(path.with_name(path.name + suffix), {}) as writer:
            for view in some:
                writer.write_view(view)
    spec = ScanSpec(scan_id="scan", tree_id="t", waypoints=(), config=MethodConfig())
    BusFeed(rig.feeder).catch_up(spec, path)
    rig.start_ready_worker()
    wait_for(lambda: rig.caught_up)
    assert rig.caught_up == [("scan", 10, [])]


def test_a_scan_under_way_is_sent_without_its_recording_being_read(rig, views):
    path = rig.folder / "scan.mcap"
    spec = ScanSpec(scan_id="scan", tree_id="t", waypoints=(), config=MethodConfig())
    feed = BusFeed(rig.feeder)
    rig.start_ready_worker()
    with RecordingWriter(path, {"scan_id": "scan"}) as writer:
        feed.begin(spec, rig.folder / "elsewhere.mcap")
        for view in views[:4]:
            feed.offer("scan", view.index, writer.write_view(view))
        assert rig.feeder.flush(20)
    assert feed.skeleton("scan") == rig.replayed(name="scan")


class PausedError(Exception):
    pass


def test_a_scan_that_goes_on_sends_no_view_from_where_it_was_in_the_file_before(rig, views):
    worker = rig.start_ready_worker()
    with suppress(PausedError), rig.scan() as writer:
        for view in views[:3]:
            writer.write_event(view.stamp_ns, {"kind": "view", "index": view.index})
            writer.write_view(view)
            rig.feeder.offer(view.index)  # to be read from the recording
        assert rig.feeder.flush(20)
        raise PausedError
    worker.kill()
    wait_for(lambda: not rig.feeder.worker_status().ready, 5)
    source, path = rig.source(rig.scan_id), rig.folder / f"{rig.scan_id}.mcap"
    rig.feeder.begin(source)
    aside = set_aside(path)
    with RecordingWriter(path, {"scan_id": rig.scan_id}) as writer:
        for index in carry_over(aside, writer):
            rig.feeder.offer(index)
        aside.unlink()
        rig.start_ready_worker()
        assert rig.feeder.flush(20)
        record_more(rig, writer, views[3:6])
    assert rig.feeder.flush(20)
    document = rig.feeder.latest_skeleton(rig.scan_id)
    assert from_json(document).views_rejected == ()
    assert document == rig.replayed()


def test_a_view_is_read_from_the_file_that_has_the_name_now(tmp_path, views):
    path, other, recorded = tmp_path / "scan.mcap", tmp_path / "other.mcap", RecordedViews()
    for name, some in ((path, views[:3]), (other, views[1:4])):
        with RecordingWriter(name, {}) as writer:
            written = {view.index: writer.write_view(view) for view in some}
    assert recorded.messages(path, 1) == written[1]
    other.replace(path)
    assert recorded.messages(path, 2) == written[2]
    assert recorded.messages(path, 3) == written[3]


def test_recordings_of_an_earlier_service_are_fed_after_the_scan_under_way(tmp_path, views):
    with Rig(tmp_path) as rig:
        first, second = record(rig, views), record(rig, views[:5])
    with Rig(tmp_path) as rig:
        for name in (first, second):
            rig.feeder.catch_up(rig.source(name))
        rig.scan_id = "scan-of-now"
        rig.feeder.begin(rig.source("scan-of-now", recording=rig.source(second).recording))
        for view in views[:5]:
            rig.feeder.offer(view.index)
        rig.feeder.catch_up(rig.source("scan-of-now"))  # it is under way: nothing to do
        rig.start_ready_worker()
        assert rig.feeder.flush(20)
        assert {name for name, _ in rig.documents} == {"scan-of-now"}
        for name in (first, second):
            wait_for_skeleton(rig, name)
        wait_for(lambda: len(rig.caught_up) == 2)
        assert rig.caught_up == [(first, 10, []), (second, 5, [])]


def test_what_no_worker_takes_holds_nothing_up_and_is_said(rig, views, monkeypatch):
    monkeypatch.setattr("service.offered._PATIENCE_S", 0.05)
    strange = record(rig, views[:1], segmenter="eyes")
    good = record(rig, views)
    unusable = record(rig, views[6:7])
    rig.feeder.catch_up(rig.source("never-recorded"))
    record(rig, views[:1], segmenter="ears")
    rig.start_ready_worker()
    wait_for(lambda: len(rig.caught_up) == 4, 60)
    assert sorted(rig.caught_up) == sorted(
        [(strange, 1, [0]), (good, 10, []), (unusable, 1, []), ("never-recorded", 0, [])]
    )
    wait_for_skeleton(rig, good)


@pytest.fixture
def bad_disk(tmp_path):
    """A recording that opens and cannot be read: EIO, as from a bad sector."""
    path = tmp_path / "bad.mcap"
    path.symlink_to("/proc/self/mem")
    return path


def not_even_found():
    raise OSError(errno.EIO, "Input/output error")


def test_a_recording_that_the_disk_does_not_give_keeps_no_other_from_being_sent(
    rig, views, bad_disk
):
    good = record(rig, views[:3])
    for name, recording in (("on-a-bad-sector", lambda: bad_disk), ("lost", not_even_found)):
        rig.feeder.catch_up(rig.source(name, recording=recording))
    rig.feeder.begin(rig.source("under-way"))
    rig.start_ready_worker()
    wait_for(lambda: len(rig.caught_up) == 3)
    assert sorted(rig.caught_up) == [("lost", 0, []), ("on-a-bad-sector", 0, []), (good, 3, [])]
    wait_for_skeleton(rig, good)


def test_a_disk_that_fails_during_a_scan_ends_the_sending_of_no_later_one(rig, views, bad_disk):
    rig.start_ready_worker()
    for name, recording in (("on-a-bad-sector", lambda: bad_disk), ("lost", not_even_found)):
        rig.feeder.begin(rig.source(name, recording=recording))
        rig.feeder.offer(0)
        assert not rig.feeder.flush(0.5)
    scan = record(rig, views[:3])
    assert rig.feeder.flush(20)
    assert rig.feeder.latest_skeleton(scan) == rig.replayed()


def test_who_fails_to_hear_of_a_scan_does_not_end_the_sending(rig, views):
    class Deaf(list):
        def append(self, told):
            super().append(told)
            raise RuntimeError("no room to note it")

    rig.caught_up = Deaf()
    first, second = record(rig, views[:2]), record(rig, views[:3])
    rig.feeder.begin(rig.source("under-way"))
    rig.start_ready_worker()
    wait_for(lambda: len(rig.caught_up) == 2)
    assert rig.caught_up == [(first, 2, []), (second, 3, [])]
    assert rig.feeder.worker_status().ready


@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
def test_a_feeder_that_has_ended_is_seen(rig, views):
    class Fatal(list):
        def append(self, told):
            raise SystemExit

    rig.caught_up = Fatal()
    record(rig, views[:1])
    rig.feeder.begin(rig.source("under-way"))
    rig.start_ready_worker()
    wait_for(lambda: "no view is sent to it any more" in rig.feeder.worker_status().detail)
    assert not rig.feeder.worker_status().ready
