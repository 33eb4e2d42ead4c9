"""The whole service as the live tests know it: HTTP in front, fake controller and worker behind."""

import os
import re
import signal
import subprocess
import sys
import threading
import time
from contextlib import contextmanager
from functools import partial
from pathlib import Path

import httpx2
from scipy.spatial.transform import Rotation

from canopy_skel.pipeline import MethodConfig
from canopy_skel.recording import read_recording
from drivers.guarded_arm import GuardedArm
from drivers.ur5.arm import Ur5Arm
from drivers.ur5.messages import Ur5Config
from mock_hw.fake_ur.process import FakeUr, free_host
from mock_hw.orchard.path import TOOL_FROM_CAMERA
from mock_hw.orchard.simulate import Options, prepare
from mock_hw.sim_camera import SimCamera
from service.compose import (
    SIMULATED_LIMITS,
    SIMULATED_PATHS,
    Hardware,
    ServeOptions,
    composed,
    free_port,
    truth_of,
)
from service.replay import ReplayRequest, replay
from service.server import make_server

ORCHARD = Options(species="apple", leaf_count=200, weather="fair", rows=False)
TIME_SCALE = 20
PICTURE_SCALE = 0.2
CANOPY = Path(sys.executable).with_name("canopy")
RIG_PAGE = Path(__file__).parents[2] / "docs/rig.md"


class Rig:
    """A running service and what stands behind it."""

    def __init__(self, http, controller, data):
        self.http, self.controller, self.data = http, controller, data

    def post(self, path="orchard-10", **body):
        where = {} if "waypoints" in body else {"path": path}
        return self.http.post(
            "/v1/scans",
            json={"tree_id": "t1", **where, **body},
            headers={"Idempotency-Key": os.urandom(8).hex()},
        )

    def start(self, path="orchard-10", **body):
        answer = self.post(path, **body)
        assert answer.status_code == 202, answer.text
        return answer.json()["scan_id"]

    def start_slowly(self):
        """A scan of three waypoints, with a third of a second on the way to each."""
        poses = SIMULATED_PATHS["orchard-70"][:3]
        return self.start(waypoints=[waypoint(pose) for pose in poses], speed_mps=0.02)

    def status(self, scan_id):
        return self.http.get(f"/v1/scans/{scan_id}").json()

    def wait(self, scan_id, *states, views=0, timeout_s=120.0):
        until = time.perf_counter() + timeout_s
        while True:
            status = self.status(scan_id)
            if status["state"] in states and status["views_done"] >= views:
                return status
            assert status["state"] == "running", status
            assert time.perf_counter() < until, status
            time.sleep(0.05)

    def wait_until_moving(self, scan_id, views=1):
        """Wait until so many views are recorded and the arm is on its way to the next."""
        done = self.wait(scan_id, "running", views=views)["views_done"]
        wait_for(lambda: self.controller.do("state")["moving"], f"{done} views, but it stands")

    def stamps(self, scan_id):
        """When each recorded view was exposed, by its index."""
        folder = self.data / "scans" / scan_id
        recording = read_recording(next(folder.glob("*.mcap*")))
        return {view.index: view.stamp_ns for view in recording.views()}

    def views(self, scan_id):
        return list(self.stamps(scan_id))

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

    def wait_for_skeleton(self, scan_id, expected, timeout_s=60.0):
        wait_for(lambda: self.skeleton(scan_id) == expected, "another skeleton", timeout_s)

    def part(self, name):
        parts = self.http.get("/v1/rig").json()["parts"]
        return next(part for part in parts if part["name"] == name)

    def acknowledge(self):
        return self.http.post("/v1/rig:acknowledge", json={"reason": "looked"})

    def resume(self, scan_id):
        return self.http.post(f"/v1/scans/{scan_id}:resume")

    def assert_held(self, scan_id, why):
        """Nothing starts, and every refusal says why and what to do."""
        for answer in (self.http.get("/readyz"), self.resume(scan_id), self.post()):
            assert problem(answer, 503) in ("not_ready", "rig_not_ready")
            assert re.search(why, answer.json()["detail"]), answer.text

    def assert_one_acknowledgement_lets_it_go_on(self, scan_id):
        """The arm stands still until the one command that lets it move."""
        self.assert_stands_still()
        assert self.acknowledge().status_code == 200
        assert self.http.get("/readyz").status_code == 200
        self.assert_stands_still()
        assert self.resume(scan_id).status_code == 200
        status = self.wait(scan_id, "done", "stopped", "failed")
        assert status["state"] == "done", status
        assert self.views(scan_id) == list(range(status["views_total"]))

    def assert_stands_still(self, for_s=0.4):
        wait_for(lambda: not self.controller.do("state")["moving"], "the arm still moves", 3.0)
        joints = self.controller.do("state")["joints_rad"]
        time.sleep(for_s)
        assert self.controller.do("state")["joints_rad"] == joints

    def tidy_up(self):
        """Leave the rig ready and without a scan, whatever a test did to it."""
        self.controller.do("reset")  # the driver is to see that its program is gone
        time.sleep(0.3)
        for scan in self.http.get("/v1/scans").json()["scans"]:
            if scan["state"] not in ("done", "cancelled", "failed"):
                self.http.post(f"/v1/scans/{scan['scan_id']}:cancel")
        wait_for(lambda: self.acknowledge().status_code == 200, "not acknowledged")
        wait_until_ready(self.http)


def rig_file(folder, *changes):
    """Write the rig file of the documentation, with (old, new) changes; return its path."""
    text = re.search(r"```toml\n(.*?)```", RIG_PAGE.read_text(), re.DOTALL).group(1)
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    path = folder / "rig.toml"
    path.write_text(text)
    return path


def environment():
    """Have a process find the modules that we find, not those installed elsewhere."""
    return os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))}


def waypoint(base_from_tool0):
    """A pose as requests have it."""
    return {
        "position": base_from_tool0[:3, 3].tolist(),
        "quaternion_xyzw": Rotation.from_matrix(base_from_tool0[:3, :3]).as_quat().tolist(),
    }


def problem(answer, status):
    """Check that an answer is a problem document with this status; return its code."""
    assert answer.status_code == status, answer.text
    assert answer.headers["content-type"] == "application/problem+json"
    body = answer.json()
    assert body["status"] == status
    assert body["title"]
    assert body["detail"]
    return body["code"]


@contextmanager
def hardware_at(host, camera=None):
    """An arm at a controller and, unless another camera is given, the simulated one."""
    # More patient than the rig's: a busy machine is silent for a moment, too.
    patient = Ur5Config(host=host, watchdog_hz=1.0, stale_after_s=0.8)
    arm = GuardedArm(Ur5Arm(patient), SIMULATED_LIMITS)
    cell = {"arm": arm, "limits": SIMULATED_LIMITS, "paths": SIMULATED_PATHS}
    if camera is not None:
        yield Hardware(
            camera=camera, tool_from_camera=TOOL_FROM_CAMERA, attachments=lambda _: {}, **cell
        )
        return
    simulation = prepare(ORCHARD)
    sim = SimCamera(lambda: arm.state().pose, simulation, scale=PICTURE_SCALE)
    yield Hardware(
        camera=sim,
        tool_from_camera=simulation.tool_from_camera,
        attachments=partial(truth_of, sim),
        **cell,
    )


def options_for(data):
    return ServeOptions(
        data=data,
        robot=None,
        site="test",
        rig="rig-1",
        orchard=ORCHARD,
        time_scale=TIME_SCALE,
        picture_scale=PICTURE_SCALE,
    )


@contextmanager
def served(data, camera=None, version="3.15", hardware_at=hardware_at):
    """Serve in this process, before a controller of its own."""
    with (
        FakeUr(free_host(), version=version, time_scale=TIME_SCALE) as controller,
        composed(options_for(data), lambda _: hardware_at(controller.host, camera)) as app,
    ):
        port = free_port()
        server = make_server(app, port=port, log_level="warning")
        thread = threading.Thread(target=server.run)
        thread.start()
        try:
            with httpx2.Client(base_url=f"http://127.0.0.1:{port}", timeout=30.0) as http:
                yield Rig(http, controller, data)
        finally:
            server.handle_exit(signal.SIGTERM, None)
            thread.join(10)


class Service:
    """The service in a process of its own, with what it started.

    command: what to run, without the port. controller: before which it stands, if that is not one
    of its own; it outlives the service.
    """

    def __init__(self, data, command, controller=None):
        self._command, self._data, self._controller = command, data, controller

    def launch(self):
        port = free_port()
        command = [*map(str, self._command), "--port", str(port)]
        self.process = subprocess.Popen(command, stderr=subprocess.DEVNULL, env=environment())
        self.http = httpx2.Client(base_url=f"http://127.0.0.1:{port}", timeout=30.0)
        wait_until_answering(self.http)
        return Rig(self.http, self._controller, self._data)

    def kill(self):
        """As the kernel does when memory is short: nobody is told."""
        family = processes("", self.process.pid)
        assert len(family) >= 2
        self.process.kill()
        self.process.wait()
        self.http.close()
        wait_for(lambda: not any(map(alive, family)), "children outlive the service", 10.0)

    def end(self):
        self.http.close()
        self.process.terminate()
        return self.process.wait(10)


def wait_for(condition, otherwise, timeout_s=20.0):
    until = time.perf_counter() + timeout_s
    while not condition():
        assert time.perf_counter() < until, otherwise
        time.sleep(0.02)


def wait_until_answering(http, timeout_s=60.0):
    def answers():
        try:
            return http.get("/healthz").status_code == 200
        except httpx2.TransportError:
            return False

    wait_for(answers, "no answer", timeout_s)


def wait_until_ready(http, timeout_s=60.0):
    """Wait for every part, the worker too."""
    wait_until_answering(http, timeout_s)

    def ready():
        return all(part["ready"] for part in http.get("/v1/rig").json()["parts"])

    wait_for(ready, "not ready", timeout_s)


def processes(of, ancestor=None):
    """Pids of what `ancestor` (this process) started, whose command line holds `of`."""
    ancestor = ancestor or os.getpid()
    parents = {int(entry.name): _parent(entry.name) for entry in _entries()}
    found = []
    for pid in parents:
        line = pid
        while line not in (None, ancestor):
            line = parents.get(line)
        if line == ancestor and pid != ancestor and of in _command_line(pid):
            found.append(pid)
    return found


def alive(pid):
    """Say whether a process runs; one that only waits to be buried does not."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] not in "ZX"
    except OSError:
        return False


def _entries():
    return [entry for entry in Path("/proc").iterdir() if entry.name.isdecimal()]


def _command_line(pid):
    try:
        return Path(f"/proc/{pid}/cmdline").read_bytes().replace(b"\0", b" ").decode()
    except OSError:
        return ""


def _parent(pid):
    try:
        return int(Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[1])
    except OSError:
        return None
