"""The whole service: HTTP, ur-rtde against the fake controller, zenoh, a worker process.

Each fault says what the operator sees over HTTP; nothing captured is lost and nothing moves.
"""

import json
import os
import resource
import signal
import subprocess
import sys
import threading
import time
from contextlib import contextmanager
from pathlib import Path

import httpx2
import pytest

from canopy_skel.document import to_json
from canopy_skel.pipeline import MethodConfig
from canopy_skel.recording import read_recording
from canopy_skel.recording.reader import GROUND_TRUTH
from mock_hw.fake_ur.process import FakeUr, free_host
from mock_hw.orchard.simulate import Options, prepare
from mock_hw.sim_camera import SimCamera
from service.compose import Hardware, ServeOptions, composed, free_port, guarded
from service.replay import ReplayRequest, replay
from service.server import make_server

pytest.importorskip("rtde_control", reason="ur-rtde has no wheel for this Python")
ORCHARD = Options(species="apple", leaf_count=200, weather="fair", rows=False)


class Rig:
    """A running service and what stands behind it."""

    def __init__(self, http, controller, camera, data):
        self.http, self.controller, self.camera, self.data = http, controller, camera, data

    def start(self, path="orchard-10", **body):
        answer = self.http.post(
            "/v1/scans",
            json={"tree_id": "t1", "path": path, **body},
            headers={"Idempotency-Key": os.urandom(8).hex()},
        )
        assert answer.status_code == 202, answer.text
        return answer.json()["scan_id"]

    def status(self, scan_id):
        return self.http.get(f"/v1/scans/{scan_id}").json()

    def wait(self, scan_id, *states, views=0, timeout_s=120.0):
        until = time.perf_counter() + timeout_s
        while True:
            status = self.status(scan_id)
            if status["state"] in states and status["views_done"] >= views:
                return status
            assert time.perf_counter() < until, status
            time.sleep(0.05)

    def views(self, scan_id):
        folder = self.data / "scans" / scan_id
        return [view.index for view in read_recording(next(folder.glob("*.mcap*"))).views()]

    def replayed(self, scan_id, out):
        request = ReplayRequest(
            config=MethodConfig(),
            segmenter="recorded",
            formats=("json",),
            topics=None,
            memory_limit_bytes=1 << 30,
        )
        recording = self.data / "scans" / scan_id / f"{scan_id}.mcap"
        out.mkdir(exist_ok=True)
        replay(recording, out, request, lambda done, total: None)
        return (out / f"{scan_id}.skeleton.json").read_bytes()

    def skeleton(self, scan_id):
        return self.http.get(f"/v1/scans/{scan_id}/skeleton.json").content

    def acknowledge_until_ready(self, timeout_s=20.0):
        """As an operator does: look, acknowledge, and again if something else comes up."""
        until = time.perf_counter() + timeout_s
        while not all(part["ready"] for part in self.http.get("/v1/rig").json()["parts"]):
            assert time.perf_counter() < until, self.http.get("/v1/rig").text
            self.http.post("/v1/rig:acknowledge", json={"reason": "looked"})
            time.sleep(0.2)

    def resume(self, scan_id, timeout_s=20.0):
        """As an operator does: a controller that comes back may tell of one stop after another."""
        until = time.perf_counter() + timeout_s
        while (answer := self.http.post(f"/v1/scans/{scan_id}:resume")).status_code != 200:
            assert answer.status_code == 503, answer.text
            assert time.perf_counter() < until, answer.text
            self.acknowledge_until_ready()

    def assert_stands_still(self):
        time.sleep(0.2)
        joints = self.controller.do("state")["joints_rad"]
        time.sleep(0.4)
        assert self.controller.do("state")["joints_rad"] == joints


@contextmanager
def served(data, scale=0.2, time_scale=20):
    handles = {}

    @contextmanager
    def hardware(options):
        simulation = prepare(options.orchard)
        with FakeUr(free_host(), time_scale=options.time_scale) as controller:
            arm = guarded(controller.host)
            camera = SimCamera(lambda: arm.state().pose, simulation, scale=options.picture_scale)
            handles.update(controller=controller, camera=camera)
            truth = {GROUND_TRUTH: to_json(camera.truth())}
            yield Hardware(arm, camera, simulation.tool_from_camera, lambda: truth)

    options = ServeOptions(
        data=data,
        robot=None,
        site="test",
        rig="rig-1",
        orchard=ORCHARD,
        time_scale=time_scale,
        picture_scale=scale,
    )
    with composed(options, hardware) as app:
        port = free_port()
        server = make_server(app, port=port, log_level="warning")
        thread = threading.Thread(target=server.run)
        thread.start()
        try:
            with httpx2.Client(base_url=f"http://127.0.0.1:{port}", timeout=30.0) as http:
                rig = Rig(http, handles["controller"], handles["camera"], data)
                wait_until_ready(http)
                yield rig
        finally:
            server.handle_exit(signal.SIGTERM, None)
            thread.join(10)


def wait_until_ready(http, timeout_s=60.0):
    until = time.perf_counter() + timeout_s
    while True:
        try:
            parts = http.get("/v1/rig").json()["parts"]
            if all(part["ready"] for part in parts):
                return
        except httpx2.TransportError:
            parts = "no answer"
        assert time.perf_counter() < until, parts
        time.sleep(0.1)


def processes(of):
    """Pids of running processes whose command line holds `of`."""
    found = []
    for entry in Path("/proc").iterdir():
        if entry.name.isdecimal():
            try:
                line = (entry / "cmdline").read_bytes().replace(b"\0", b" ").decode()
            except OSError:
                continue
            if of in line and int(entry.name) != os.getpid():
                found.append(int(entry.name))
    return found


@pytest.fixture(scope="module")
def shared(tmp_path_factory):
    with served(tmp_path_factory.mktemp("data")) as rig:
        yield rig


@pytest.fixture
def rig(shared):
    yield shared
    shared.controller.do("reset")
    time.sleep(0.1)
    shared.acknowledge_until_ready()
    for scan in shared.http.get("/v1/scans").json()["scans"]:
        if scan["state"] not in ("done", "cancelled", "failed"):
            shared.http.post(f"/v1/scans/{scan['scan_id']}:cancel")
    wait_until_ready(shared.http)


def test_live_and_replayed_skeletons_are_the_same_bytes(rig, tmp_path):
    scan_id = rig.start()
    rig.wait(scan_id, "done", views=10)
    live = rig.skeleton(scan_id)
    assert rig.views(scan_id) == list(range(10))
    assert live == rig.replayed(scan_id, tmp_path)
    answer = rig.http.get(f"/v1/scans/{scan_id}/skeleton.glb")
    assert answer.content[:4] == b"glTF"


@pytest.mark.timeout(400)
def test_a_scan_of_paper_size(rig):
    scan_id = rig.start("orchard-70")
    status = rig.wait(scan_id, "done", timeout_s=300)
    assert status["views_done"] == status["views_total"] == 70
    assert rig.views(scan_id) == list(range(70))


@pytest.mark.parametrize(
    ("fault", "says"),
    [
        ("protective_stop", "ProtectiveStopError"),
        ("emergency_stop", "EmergencyStopError"),
        ("power_off", "NotPoweredError"),
        ("cut_link", "LinkLostError"),
        ("freeze", "ControllerFrozenError"),
    ],
)
def test_a_fault_of_the_arm_stops_the_scan_and_an_operator_lets_it_go_on(rig, fault, says):
    scan_id = rig.start()
    rig.wait(scan_id, "running", views=1)
    rig.controller.do(fault)
    status = rig.wait(scan_id, "stopped")
    assert says in status["detail"]
    assert rig.views(scan_id) == list(range(status["views_done"]))
    refused = rig.http.post(f"/v1/scans/{scan_id}:resume")
    assert refused.status_code == 503
    assert refused.headers["content-type"] == "application/problem+json"
    rig.assert_stands_still()
    rig.controller.do("reset")
    rig.acknowledge_until_ready()
    rig.assert_stands_still()
    rig.resume(scan_id)
    rig.wait(scan_id, "done", views=10)
    assert rig.views(scan_id) == list(range(10))


def test_a_killed_driver_process_stops_the_scan(rig):
    scan_id = rig.start()
    rig.wait(scan_id, "running", views=1)
    (child,) = processes("drivers.ur5.child")
    os.kill(child, signal.SIGKILL)
    status = rig.wait(scan_id, "stopped", "done")
    if status["state"] == "stopped":
        assert "Error" in status["detail"]
    assert rig.views(scan_id) == list(range(status["views_done"]))


@pytest.mark.parametrize("view", [1, 5])
def test_a_killed_worker_comes_back_and_ends_with_the_same_bytes(rig, view, tmp_path):
    scan_id = rig.start()
    rig.wait(scan_id, "running", views=view)
    for pid in processes("service.worker --connect"):
        os.kill(pid, signal.SIGKILL)
    rig.wait(scan_id, "done", views=10)
    until = time.perf_counter() + 60
    while rig.skeleton(scan_id) != (expected := rig.replayed(scan_id, tmp_path)):
        assert time.perf_counter() < until, len(expected)
        time.sleep(0.5)


def test_a_second_scan_is_refused_and_stop_is_heard_at_once(rig):
    scan_id = rig.start()
    rig.wait(scan_id, "running", views=1)
    second = rig.http.post(
        "/v1/scans",
        json={"tree_id": "t2", "path": "orchard-10"},
        headers={"Idempotency-Key": os.urandom(8).hex()},
    )
    assert second.status_code == 409
    assert rig.http.post("/v1/rig:stop").status_code == 200
    rig.wait(scan_id, "stopped")
    rig.assert_stands_still()


class Service:
    """`canopy serve --sim` in a process of its own; what it left running is ended with it."""

    def __init__(self, data):
        self._command = [Path(sys.executable).with_name("canopy"), "serve", "--sim", "--data", data]
        self._command += ["--time-scale", "20", "--picture-scale", "0.2", "--leaves", "200"]
        self._data = data

    def launch(self):
        port = free_port()
        command = [*map(str, self._command), "--port", str(port)]
        self.process = subprocess.Popen(command, stderr=subprocess.DEVNULL)
        self.http = httpx2.Client(base_url=f"http://127.0.0.1:{port}", timeout=30.0)
        wait_until_ready(self.http)
        return Rig(self.http, None, None, self._data)

    def kill(self):
        self.process.kill()
        self.process.wait()
        self.http.close()

    def end(self):
        self.http.close()
        self.process.terminate()
        code = self.process.wait(10)
        for orphan in processes("mock_hw.fake_ur"):
            if _parent(orphan) == 1:
                os.kill(orphan, signal.SIGKILL)
        return code


@pytest.fixture
def service(tmp_path):
    running = Service(tmp_path)
    yield running
    assert running.end() == 0


@pytest.mark.timeout(200)
def test_a_killed_service_leaves_a_scan_that_can_be_resumed(service):
    rig = service.launch()
    scan_id = rig.start()
    rig.wait(scan_id, "running", views=2)
    service.kill()
    assert len(rig.views(scan_id)) >= 2
    rig = service.launch()
    status = rig.status(scan_id)
    assert status["state"] == "stopped"
    assert status["detail"]
    rig.resume(scan_id)
    rig.wait(scan_id, "done", views=10)
    assert rig.views(scan_id) == list(range(10))


@pytest.mark.timeout(200)
def test_a_full_disk_stops_the_scan_and_costs_nothing(service):
    rig = service.launch()
    scan_id = rig.start()
    done = rig.wait(scan_id, "running", views=1)["views_done"]
    part = rig.data / "scans" / scan_id / f"{scan_id}.mcap.part"
    # Like a full disk for that process: no file can grow beyond what the recording has now.
    limit = (part.stat().st_size + 20_000, resource.RLIM_INFINITY)
    before = resource.prlimit(service.process.pid, resource.RLIMIT_FSIZE, limit)
    status = rig.wait(scan_id, "stopped")
    resource.prlimit(service.process.pid, resource.RLIMIT_FSIZE, before)
    assert "too large" in status["detail"] or "space" in status["detail"]
    assert rig.views(scan_id)[:done] == list(range(done))
    rig.resume(scan_id)
    rig.wait(scan_id, "done", views=10)
    assert rig.views(scan_id) == list(range(10))


def _parent(pid):
    return int(Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[1])


def test_a_scan_from_the_shell_brings_recording_and_skeleton(rig, tmp_path):
    command = [Path(sys.executable).with_name("canopy"), "scan", "--json", "--tree", "t3"]
    command += ["--url", str(rig.http.base_url), "-o", tmp_path]
    result = subprocess.run(
        [*map(str, command)], capture_output=True, text=True, check=False, timeout=200
    )
    assert result.returncode == 0, result.stderr
    scanned = json.loads(result.stdout)
    assert scanned["state"] == "done"
    recording, skeleton = (Path(file) for file in scanned["files"])
    assert len(list(read_recording(recording).views())) == 10
    assert skeleton.read_bytes() == rig.replayed(scanned["scan_id"], tmp_path / "again")
