"""The whole service: HTTP, ur-rtde against the fake controller, zenoh, a worker process.

What arm, camera and worker can do to a scan is in test_live_faults, what is refused in
test_live_refusals.
"""

import json
import os
import re
import resource
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from live_rig import (
    CANOPY,
    TIME_SCALE,
    Service,
    environment,
    problem,
    processes,
    served,
    wait_until_ready,
)
from live_service import read_events

from canopy_skel.recording import read_recording
from mock_hw.fake_ur.process import FakeUr, free_host

DEMO = Path(__file__).parents[2] / "recordings/demo_apple.mcap"
pytest.importorskip("rtde_control", reason="ur-rtde has no wheel for this Python")


@pytest.fixture(scope="module")
def shared(tmp_path_factory):
    with served(tmp_path_factory.mktemp("data")) as rig:
        wait_until_ready(rig.http)
        yield rig


@pytest.fixture
def rig(shared):
    yield shared
    shared.tidy_up()


def test_live_and_replayed_skeletons_are_the_same_bytes(rig, tmp_path):
    scan_id = rig.start()
    rig.wait(scan_id, "done", views=10)
    live = rig.skeleton(scan_id)
    assert rig.views(scan_id) == list(range(10))
    assert live == rig.replayed(scan_id, tmp_path)
    answer = rig.http.get(f"/v1/scans/{scan_id}/skeleton.glb")
    assert answer.content[:4] == b"glTF"
    with rig.http.stream("GET", f"/v1/scans/{scan_id}/events") as stream:
        told = [event["data"] for event in read_events(stream) if event["event"] == "skeleton"]
    assert told[-1]["fields"] == {"revision": 10, "preview": False, "bytes": len(live)}


def test_replays_give_the_bytes_that_the_command_line_gives(rig, tmp_path):
    """The recording that is sent says the hand-eye transform only once."""
    answer = rig.http.post(
        "/v1/replays", content=DEMO.read_bytes(), headers={"Content-Type": "application/x-mcap"}
    )
    sent = answer.json()["scan_id"]
    assert rig.wait(sent, "done")["views_done"] == 4
    told_in_it = read_recording(DEMO).scan_id.encode()
    assert rig.skeleton(sent) == rig.replayed(sent, tmp_path).replace(told_in_it, sent.encode())
    again = rig.http.post("/v1/replays", json={"scan_id": sent, "method": "paper"}).json()
    assert rig.wait(again["scan_id"], "done")["views_done"] == 4
    document = json.loads(rig.skeleton(again["scan_id"]))
    assert (document["method"]["name"], document["views"]["used"]) == ("paper", 4)
    picture = rig.http.get(f"/v1/scans/{sent}/views/3/color.jpg")
    assert picture.content[:2] == b"\xff\xd8"


@pytest.mark.timeout(400)
def test_a_scan_of_paper_size(rig):
    scan_id = rig.start("orchard-70")
    status = rig.wait(scan_id, "done", timeout_s=300)
    assert status["views_done"] == status["views_total"] == 70
    assert rig.views(scan_id) == list(range(70))


@pytest.mark.parametrize("view", [1, 5])
def test_a_killed_worker_comes_back_and_ends_with_the_same_bytes(rig, view, tmp_path):
    scan_id = rig.start()
    rig.wait(scan_id, "running", views=view)
    (worker,) = processes("service.worker")
    os.kill(worker, signal.SIGKILL)
    rig.wait(scan_id, "done", views=10)
    rig.wait_for_skeleton(scan_id, rig.replayed(scan_id, tmp_path))


def test_a_second_scan_is_refused_and_stop_is_heard_at_once(rig):
    scan_id = rig.start()
    rig.wait(scan_id, "running", views=1)
    assert problem(rig.post(), 409) == "rig_busy"
    assert rig.http.post("/v1/rig:stop").status_code == 200
    rig.wait(scan_id, "stopped")
    rig.assert_held(scan_id, "stopped by the operator")
    rig.assert_one_acknowledgement_lets_it_go_on(scan_id)


@pytest.fixture
def service(tmp_path):
    """The service in a process of its own, at a controller that outlives it."""
    script = Path(__file__).with_name("served_at.py")
    with FakeUr(free_host(), time_scale=TIME_SCALE) as controller:
        command = [sys.executable, script, "--host", controller.host, "--data", tmp_path]
        running = Service(tmp_path, command, controller)
        yield running
        assert running.end() == 0


@pytest.mark.timeout(200)
def test_a_killed_service_leaves_the_arm_at_rest_and_its_scan_can_be_resumed(service):
    rig = service.launch()
    wait_until_ready(rig.http)
    scan_id = rig.start()
    rig.wait_until_moving(scan_id, views=2)
    service.kill()
    rig.assert_stands_still()
    before = rig.stamps(scan_id)
    assert len(before) >= 2
    rig = service.launch()
    status = rig.status(scan_id)
    assert status["state"] == "stopped"
    assert status["detail"]
    rig.assert_held(scan_id, f"the service ended during scan {scan_id}: look at the arm")
    rig.assert_one_acknowledgement_lets_it_go_on(scan_id)
    assert before.items() <= rig.stamps(scan_id).items()


@pytest.mark.timeout(200)
def test_a_stop_outlives_the_service(service):
    rig = service.launch()
    wait_until_ready(rig.http)
    scan_id = rig.start()
    rig.wait_until_moving(scan_id, views=1)
    assert rig.http.post("/v1/rig:stop").status_code == 200
    rig.wait(scan_id, "stopped")
    service.kill()
    rig = service.launch()
    rig.assert_held(scan_id, f"scan {scan_id} was stopped before the service was started again")
    rig.assert_one_acknowledgement_lets_it_go_on(scan_id)


@pytest.mark.timeout(200)
def test_a_scan_that_had_no_worker_gets_its_skeleton_from_the_next_service(service, tmp_path):
    rig = service.launch()
    wait_until_ready(rig.http)
    scan_id = rig.start()
    rig.wait(scan_id, "running", views=1)
    (worker,) = processes("service.worker", service.process.pid)
    os.kill(worker, signal.SIGSTOP)
    rig.wait(scan_id, "done", views=10)
    os.kill(worker, signal.SIGKILL)
    service.kill()
    rig = service.launch()
    replayed = rig.replayed(scan_id, tmp_path / "replayed")
    assert rig.skeleton(scan_id) != replayed
    rig.wait_for_skeleton(scan_id, replayed)


@pytest.mark.timeout(200)
def test_a_full_disk_stops_the_scan_and_costs_nothing(service):
    rig = service.launch()
    wait_until_ready(rig.http)
    scan_id = rig.start()
    rig.wait(scan_id, "running", views=1)
    before = rig.stamps(scan_id)
    part = rig.data / "scans" / scan_id / f"{scan_id}.mcap.part"
    # Like a full disk for that process: no file can grow beyond what the recording has now.
    limit = (part.stat().st_size + 20_000, resource.RLIM_INFINITY)
    usual = resource.prlimit(service.process.pid, resource.RLIMIT_FSIZE, limit)
    status = rig.wait(scan_id, "stopped")
    resource.prlimit(service.process.pid, resource.RLIMIT_FSIZE, usual)
    assert "too large" in status["detail"] or "space" in status["detail"]
    rig.assert_held(scan_id, re.escape(status["detail"]))
    rig.assert_one_acknowledgement_lets_it_go_on(scan_id)
    assert before.items() <= rig.stamps(scan_id).items()


def test_a_killed_simulation_leaves_no_process_behind(tmp_path):
    options = ("--sim", "--time-scale", "20", "--picture-scale", "0.2", "--leaves", "200")
    service = Service(tmp_path, [CANOPY, "serve", "--data", tmp_path, *options])
    rig = service.launch()
    wait_until_ready(rig.http)
    assert processes("mock_hw.fake_ur", service.process.pid)
    service.kill()


def test_a_scan_from_the_shell_brings_recording_and_skeleton(rig, tmp_path):
    command = [CANOPY, "scan", "--json", "--tree", "t3"]
    command += ["--url", str(rig.http.base_url), "-o", tmp_path]
    result = subprocess.run(
        [*map(str, command)],
        capture_output=True,
        text=True,
        check=False,
        timeout=200,
        env=environment(),
    )
    assert result.returncode == 0, result.stderr
    scanned = json.loads(result.stdout)
    assert scanned["state"] == "done"
    recording, skeleton = (Path(file) for file in scanned["files"])
    assert len(list(read_recording(recording).views())) == 10
    assert skeleton.read_bytes() == rig.replayed(scanned["scan_id"], tmp_path / "again")
