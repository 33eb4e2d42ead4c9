"""What the whole service refuses over HTTP, with the reason and the mend, before anything moves.

An e-Series controller stands behind it, and no worker: that one may be missing.
"""

import importlib.util
import re
import time
from contextlib import ExitStack, nullcontext

import numpy as np
import pytest
from live_rig import (
    CANOPY,
    TIME_SCALE,
    Service,
    hardware_at,
    problem,
    rig_file,
    served,
    wait_for,
    wait_until_answering,
    waypoint,
)

from mock_hw.fake_ur.process import FakeUr, free_host
from service.compose import SIMULATED_PATHS

pytest.importorskip("rtde_control", reason="ur-rtde has no wheel for this Python")
HERE = SIMULATED_PATHS["orchard-70"][0]


@pytest.fixture(scope="module")
def shared(tmp_path_factory):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("service.compose.Supervised", lambda *command: nullcontext())
        with served(tmp_path_factory.mktemp("data"), version="5.15") as rig:
            wait_until_answering(rig.http)
            wait_for(lambda: rig.http.get("/readyz").status_code == 200, "not ready")
            yield rig


@pytest.fixture
def rig(shared):
    """The service; whatever a test has it refuse, nothing may have moved."""
    joints = shared.controller.do("state")["joints_rad"]
    yield shared
    assert shared.controller.do("state")["joints_rad"] == joints
    assert shared.controller.do("reset")["runtime_state"] == "STOPPED"
    wait_for(lambda: shared.http.get("/readyz").status_code == 200, "not ready")


def at(*position_m):
    pose = np.array(HERE)
    pose[:3, 3] = position_m
    return waypoint(pose)


def test_waypoints_that_cannot_be_driven_to_are_refused_one_by_one(rig):
    in_the_row = at(0.8, 0.0, 0.1)
    waypoints = [waypoint(HERE), at(3.0, 0.0, 0.5), in_the_row, at(-0.1, 0.91, 0.05)]
    answer = rig.post(waypoints=waypoints)
    assert problem(answer, 422) == "plan_refused"
    reasons = {one["index"]: one["reason"] for one in answer.json()["waypoints"]}
    assert set(reasons) == {1, 2, 3}
    assert "no joints bring the tool to (3.000, 0.000, 0.500) m" in reasons[1]
    assert "too close to keep-out 'tree row'" in reasons[2]
    assert "outside the workspace box" in reasons[3]
    assert "3 of 4 waypoints" in answer.json()["detail"]

    plan = rig.http.post("/v1/plans", json={"waypoints": waypoints}).json()
    assert not plan["feasible"]
    assert [one["reachable"] for one in plan["waypoints"]] == [True, False, False, False]
    assert [one["reason"] for one in plan["waypoints"]][1:] == list(reasons.values())
    assert rig.http.get("/v1/scans").json()["scans"] == []


@pytest.mark.parametrize(
    ("body", "code", "says"),
    [
        ({"speed_mps": 0.3}, "plan_refused", "speed_mps 0.3 is over the cap of 0.25"),
        ({"acceleration_mps2": 9.0}, "plan_refused", "acceleration_mps2 9 is over the cap of 0.5"),
        ({"speed_mps": -1.0}, "invalid_request", "body.speed_mps: .*greater than 0"),
        ({"speed": 0.1}, "invalid_request", "body.speed: Extra inputs are not permitted"),
        ({"tree_id": "../etc"}, "invalid_request", "body.tree_id"),
        ({"path": "up the tree"}, "unknown_path", "choose one of: orchard-10, orchard-70"),
        ({"waypoints": []}, "invalid_request", "body.waypoints"),
        (
            {"waypoints": [{"position": [0, 0, 1], "quaternion_xyzw": [0, 0, 0, 2]}]},
            "invalid_request",
            "has length 2; give a unit quaternion",
        ),
    ],
)
def test_a_request_that_makes_no_sense_is_refused(rig, body, code, says):
    answer = rig.post(**body)
    assert problem(answer, 422) == code
    assert re.search(says, answer.json()["detail"]), answer.text


def test_a_body_that_is_no_json_is_refused(rig):
    answer = rig.http.post(
        "/v1/scans",
        content=b'{"tree_id": "t1", ',
        headers={"Idempotency-Key": "1", "Content-Type": "application/json"},
    )
    assert problem(answer, 422) == "invalid_request"


@pytest.mark.parametrize("route", ["", "/events", "/skeleton", "/views/0/color.jpg"])
def test_there_is_no_such_scan(rig, route):
    assert problem(rig.http.get(f"/v1/scans/nonesuch{route}"), 404) == "unknown_scan"


@pytest.mark.parametrize("command", ["pause", "resume", "cancel"])
def test_there_is_no_such_scan_to_command(rig, command):
    assert problem(rig.http.post(f"/v1/scans/nonesuch:{command}"), 404) == "unknown_scan"


@pytest.mark.parametrize(
    ("fault", "why"),
    [
        ("local_control", "switch the controller to remote control"),
        ("power_off", "not powered or its brakes are engaged: acknowledge to power it"),
        ("emergency_stop", "release the button, then acknowledge"),
    ],
)
def test_an_arm_that_cannot_move_starts_nothing_and_says_what_to_do(rig, fault, why):
    rig.controller.do(fault)
    wait_for(lambda: not rig.part("arm")["ready"], "the arm is said to be ready")
    for answer in (rig.http.get("/readyz"), rig.post()):
        assert problem(answer, 503) in ("not_ready", "rig_not_ready")
        assert why in answer.json()["detail"]
    if fault != "power_off":
        rig.controller.do("reset")
        time.sleep(0.3)
    if fault != "local_control":
        assert rig.acknowledge().status_code == 200
    assert rig.http.get("/readyz").status_code == 200


def test_without_a_worker_scans_run_and_their_skeletons_are_pending(shared):
    absent = "no worker has reported yet; start one"
    ready = shared.http.get("/readyz")
    assert ready.status_code == 200
    worker = next(part for part in ready.json()["parts"] if part["name"] == "worker")
    assert not worker["ready"]
    assert absent in worker["detail"]
    scan_id = shared.start(waypoints=[waypoint(pose) for pose in SIMULATED_PATHS["orchard-70"][:3]])
    second = shared.post()
    assert problem(second, 409) == "rig_busy"
    assert scan_id in second.json()["detail"]
    shared.wait(scan_id, "done", views=3, timeout_s=20.0)
    assert shared.views(scan_id) == [0, 1, 2]
    pending = shared.http.get(f"/v1/scans/{scan_id}/skeleton")
    assert problem(pending, 404) == "skeleton_pending"
    assert absent in pending.json()["detail"]


@pytest.mark.usefixtures("shared")  # no worker is started
def test_a_second_service_is_refused_the_arm_until_the_first_has_ended(tmp_path):
    with FakeUr(free_host(), time_scale=TIME_SCALE) as controller, ExitStack() as second_runs:

        def before_it(_, camera):
            return hardware_at(controller.host, camera)

        with served(tmp_path / "first", hardware_at=before_it) as first:
            wait_for(lambda: first.part("arm")["ready"], "not ready")
            second = second_runs.enter_context(served(tmp_path / "second", hardware_at=before_it))
            scan_id = first.start_slowly()
            taken = (
                f"arm: ArmTakenError: the controller at {controller.host} is taken: .* end that one"
            )
            for answer in (second.http.get("/readyz"), second.post(), second.acknowledge()):
                assert problem(answer, 503) in ("not_ready", "rig_not_ready")
                assert re.search(taken, answer.json()["detail"]), answer.text
            assert not second.part("arm")["ready"]
            first.wait(scan_id, "done", views=3)
            assert first.http.get("/readyz").status_code == 200

        wait_for(lambda: second.part("arm")["ready"], "the arm is not given up")
        second.wait(second.start_slowly(), "done", views=3)


def test_a_robot_without_a_camera_starts_nothing_and_says_what_to_do(tmp_path):
    """`canopy serve --robot`, with the real camera driver and no camera."""
    installed = importlib.util.find_spec("depthai") is not None
    mend = "check cable, power and network" if installed else "pip install 'canopy-skel[oak]'"
    with FakeUr(free_host(), time_scale=20) as controller:
        robot = rig_file(tmp_path, ("192.168.0.10", controller.host))
        service = Service(tmp_path, [CANOPY, "serve", "--data", tmp_path, "--robot", robot])
        rig = service.launch()
        try:
            joints = controller.do("state")["joints_rad"]
            for answer in (rig.http.get("/readyz"), rig.post("look")):
                assert problem(answer, 503) in ("not_ready", "rig_not_ready")
                assert answer.json()["detail"].startswith("camera: NoCameraError")
                assert mend in answer.json()["detail"]
            assert rig.part("arm")["ready"]
            assert controller.do("state")["joints_rad"] == joints
        finally:
            assert service.end() == 0
