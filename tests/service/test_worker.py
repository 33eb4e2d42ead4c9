import json
import os
import random
import signal
import subprocess
import sys
import time

import pytest
import zenoh
from scenes.bus import ROOT, Rig, listening_addresses, scan_views, wait_for

from canopy_skel.document import from_json
from canopy_skel.errors import UsageError
from canopy_skel.likelihood import LikelihoodConfig
from canopy_skel.pipeline import MethodConfig
from canopy_skel.segmenters.recorded import RecordedSegmenter
from service.bus import open_session
from service.envelope import ViewEnvelope, encode_envelope
from service.feeder import ViewFeeder
from service.skeletons import SEGMENTERS
from service.worker import Worker


@pytest.fixture(scope="module")
def views():
    """Ten views; the seventh cannot be used."""
    return scan_views(unusable=(6,))


@pytest.fixture
def rig(tmp_path):
    with Rig(tmp_path) as rig:
        yield rig


@pytest.fixture(scope="module")
def lasting(tmp_path_factory):
    """A rig whose worker outlives test after test."""
    with Rig(tmp_path_factory.mktemp("rig")) as rig:
        rig.worker = rig.start_ready_worker()
        yield rig
        assert rig.worker.poll() is None


def record(rig, writer, views):
    """Write views and offer them, as a scan does."""
    for view in views:
        messages = writer.write_view(view)
        rig.feeder.offer(view.index, messages)


def arrived(rig):
    """How many views of the scan a worker has used or rejected."""
    beats = [one.heartbeat for one in rig.feeder.workers()]
    scan = [one for one in beats if one.scan_id == rig.scan_id]
    return max((len(one.views) + len(one.rejected) for one in scan), default=0)


def finish(rig, **replay):
    """Wait for the last skeleton and compare it with a replay of the recording."""
    assert rig.feeder.flush(20)
    document = rig.feeder.latest_skeleton(rig.scan_id)
    assert document == rig.replayed(**replay)
    return from_json(document)


def test_a_live_scan_gives_the_bytes_of_its_replay(lasting, views):
    with lasting.scan() as writer:
        for view in views:
            record(lasting, writer, [view])
            assert lasting.feeder.flush(10)
    document = finish(lasting)
    assert (document.views_used, [one.index for one in document.views_rejected]) == (9, [6])
    published = [from_json(data) for _, data in lasting.documents]
    assert [one.revision for one in published] == [1, 2, 3, 4, 5, 6, 6, 7, 8, 9]
    assert {scan_id for scan_id, _ in lasting.documents} == {lasting.scan_id}
    assert lasting.feeder.worker_status().ready


def test_method_and_segmenter_of_the_scan_reach_the_worker(lasting, views):
    config = MethodConfig(name="ftsem", likelihood=LikelihoodConfig(voxel_size_m=0.01))
    with lasting.scan(config=config) as writer:
        record(lasting, writer, views)
    assert finish(lasting, config=config).method.config_sha256 == config.sha256()


@pytest.mark.parametrize("k", [1, 5, 10])
def test_a_worker_killed_at_view_k_is_caught_up_by_the_next(rig, views, k):
    first = rig.start_ready_worker()
    with rig.scan() as writer:
        record(rig, writer, views[:k])
        wait_for(lambda: arrived(rig) >= k)
        first.kill()
        wait_for(lambda: not rig.feeder.worker_status().ready, 5)
        record(rig, writer, views[k:])
        rig.start_ready_worker()
        assert rig.feeder.flush(20)  # from the file that is still being written
    finish(rig)


def test_a_worker_killed_again_and_again_ends_with_the_same_bytes(rig, views):
    with rig.scan() as writer:
        for k in range(0, 10, 4):
            worker = rig.start_ready_worker()
            record(rig, writer, views[k : k + 4])
            worker.kill()
            wait_for(lambda: not rig.feeder.worker_status().ready, 5)
    rig.start_ready_worker()
    finish(rig)


def test_a_worker_that_starts_after_the_scan_gets_all_of_it(rig, views):
    with rig.scan() as writer:
        record(rig, writer, views)
    status = rig.feeder.worker_status()
    assert not status.ready
    assert "no worker has reported yet" in status.detail
    assert not rig.feeder.flush(0.2)
    assert list(rig.session.get(rig.keys.skeleton(rig.scan_id), timeout=1)) == []
    rig.start_ready_worker()
    finish(rig)


def test_order_and_repetition_of_views_do_not_matter(lasting, views):
    with lasting.scan() as writer:
        envelopes = [
            encode_envelope(
                ViewEnvelope(
                    scan_id=lasting.scan_id,
                    view=view.index,
                    config=MethodConfig(),
                    segmenter="recorded",
                    messages=writer.write_view(view),
                )
            )
            for view in views
        ]
    shuffled = envelopes * 3
    random.Random(4).shuffle(shuffled)
    for data in shuffled:
        lasting.session.put(
            lasting.keys.view(lasting.scan_id),
            data,
            congestion_control=zenoh.CongestionControl.BLOCK,
        )
    wait_for(lambda: arrived(lasting) == 10)
    finish(lasting)


class Lossy:
    """A session that loses the first few views that are put into it."""

    def __init__(self, session, losses):
        self._session, self._losses = session, losses

    def __getattr__(self, name):
        return getattr(self._session, name)

    def put(self, key, data, **options):
        if self._losses:
            self._losses -= 1
        else:
            self._session.put(key, data, **options)


def test_views_that_the_bus_loses_are_sent_again(tmp_path, views):
    with Rig(tmp_path, session=lambda session: Lossy(session, losses=5)) as rig:
        rig.start_ready_worker()
        with rig.scan() as writer:
            record(rig, writer, views)
        finish(rig)


def test_a_stalled_worker_loses_nothing_and_holds_nobody_up(rig, views):
    worker = rig.start_ready_worker()
    slowest_s = 0.0
    with rig.scan() as writer:
        record(rig, writer, views[:2])
        os.kill(worker.pid, signal.SIGSTOP)
        stalled_s = time.monotonic()
        for view in views[2:]:
            messages = writer.write_view(view)
            start_s = time.perf_counter()
            rig.feeder.offer(view.index, messages)
            slowest_s = max(slowest_s, time.perf_counter() - start_s)
            time.sleep(0.3)
        status = rig.feeder.worker_status()
        assert not status.ready
        assert "is silent for" in status.detail
        time.sleep(max(0, stalled_s + 10 - time.monotonic()))
        os.kill(worker.pid, signal.SIGCONT)
    wait_for(lambda: rig.feeder.worker_status().ready)
    finish(rig)
    assert slowest_s < 0.05


def test_the_latest_skeleton_can_be_asked_for(lasting, views):
    with lasting.scan() as writer:
        record(lasting, writer, views[:3])
    finish(lasting)
    (reply,) = lasting.session.get(lasting.keys.skeleton(lasting.scan_id), timeout=5)
    assert reply.ok.payload.to_bytes() == lasting.feeder.latest_skeleton(lasting.scan_id)
    assert str(reply.ok.encoding) == "application/json"
    assert json.loads(reply.ok.attachment.to_bytes())["revision"] == 3
    (unknown,) = lasting.session.get(lasting.keys.skeleton("nobody's"), timeout=5)
    assert str(unknown.err.encoding) == "application/problem+json"
    problem = json.loads(unknown.err.payload.to_bytes())
    assert problem["status"] == 404
    assert lasting.keys.skeleton("nobody's") in problem["detail"]


def test_a_service_that_starts_later_learns_the_latest_skeleton(lasting, views):
    with lasting.scan() as writer:
        record(lasting, writer, views[:3])
    finish(lasting)
    with ViewFeeder(lasting.session, lasting.keys) as later:
        wait_for(lambda: later.latest_skeleton(lasting.scan_id), 5)
        assert later.latest_skeleton(lasting.scan_id) == lasting.feeder.latest_skeleton(
            lasting.scan_id
        )


def test_a_bad_sample_is_said_and_survived(lasting, views):
    for bad in (b"", b"hello", b"canopy-view/1\n\xff\xff\xff\xff", b"canopy-view/9\n"):
        lasting.session.put(lasting.keys.view("scan-0"), bad)
    wait_for(lambda: "canopy-view/9" in lasting.feeder.worker_status().detail, 5)
    with lasting.scan() as writer:
        record(lasting, writer, views)
    finish(lasting)


class BreaksAtViewOne:
    """A segmenter with a fault of its own."""

    def segment(self, view):
        if view.index == 1:
            raise RuntimeError("weights are torn")
        return RecordedSegmenter().segment(view)


def test_a_fault_of_the_method_costs_one_view(rig, views, monkeypatch):
    monkeypatch.setitem(SEGMENTERS, "fragile", BreaksAtViewOne)
    with (
        open_session(connect=rig.endpoint) as session,
        Worker(session, rig.keys, "in-process").running(),
        rig.scan(segmenter="fragile") as writer,
    ):
        record(rig, writer, views[:4])
        assert rig.feeder.flush(20)
        document = from_json(rig.feeder.latest_skeleton(rig.scan_id))
        assert "weights are torn" in rig.feeder.worker_status().detail
    (rejected,) = document.views_rejected
    assert (document.views_used, rejected.index) == (3, 1)
    assert rejected.reason == "view 1: the method failed on it (RuntimeError('weights are torn'))"


def test_a_view_without_a_scan_is_refused(rig):
    with pytest.raises(UsageError, match="view 0 is of no scan; begin one first"):
        rig.feeder.offer(0)


def test_a_segmenter_that_is_not_there_is_said(lasting, views):
    with lasting.scan(segmenter="eyes") as writer:
        record(lasting, writer, views[:1])
    says = "unknown segmenter 'eyes': choose one of recorded"
    wait_for(lambda: says in lasting.feeder.worker_status().detail, 5)
    assert lasting.feeder.latest_skeleton(lasting.scan_id) is None


def test_scans_come_one_after_the_other_and_the_last_two_are_kept(lasting, views):
    names = []
    for count in (2, 3, 4):
        with lasting.scan() as writer:
            record(lasting, writer, views[:count])
        assert finish(lasting).views_used == count
        names.append(lasting.scan_id)
    replies = list(lasting.session.get(lasting.keys.skeletons, timeout=5))
    expected = {lasting.keys.skeleton(name) for name in names[1:]}
    assert {str(one.ok.key_expr) for one in replies} == expected


def test_a_worker_listens_nowhere(lasting):
    assert listening_addresses(lasting.worker.pid) == []
    service = {f"tcp/{address}:{port}" for address, port in listening_addresses(os.getpid())}
    assert lasting.endpoint in service
    assert all(endpoint.startswith("tcp/127.") for endpoint in service)


def test_a_worker_leaves_at_once_when_it_is_told(rig, views):
    worker = rig.start_ready_worker()
    with rig.scan() as writer:
        record(rig, writer, views)
        start_s = time.monotonic()
        worker.terminate()
        assert worker.wait(5) == 0
        assert time.monotonic() - start_s < 1
        wait_for(lambda: not rig.feeder.worker_status().ready, 5)
    assert "Traceback" not in rig.log


def test_a_worker_without_its_parent_leaves(rig):
    worker = rig.start_worker("--parent", str(os.getpid() + 1))
    assert worker.wait(10) == 0


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (("tcp/0.0.0.0:7447", "orchard"), "'tcp/0.0.0.0:7447' is not on the loopback"),
        (("tcp/127.0.0.1:7447", "a/b"), "site 'a/b' cannot be part of a bus key"),
    ],
)
def test_a_worker_refuses_wrong_arguments(arguments, says):
    endpoint, site = arguments
    command = [sys.executable, "-m", "service.worker", "--connect", endpoint]
    done = subprocess.run(
        [*command, "--site", site, "--rig", "arm-1"], cwd=ROOT, capture_output=True, text=True
    )
    assert done.returncode == 2
    (line,) = done.stderr.splitlines()
    assert line.startswith("error: ")
    assert says in line
