"""The fault matrix, played to the whole service in the middle of a move or an exposure.

Each line says what the operator sees over HTTP. In all of them nothing captured is lost, the arm
stands still until it is told to move, and one acknowledgement lets the scan go on to its end.
"""

import os
import re
import signal
import sys
import time
from pathlib import Path

import pytest
from live_rig import problem, processes, served, wait_for, wait_until_ready

from drivers.oak.camera import OakCamera
from drivers.oak.messages import OakConfig

pytest.importorskip("rtde_control", reason="ur-rtde has no wheel for this Python")
FAKE_OAK = Path(__file__).parents[1] / "drivers/fake_oak_child.py"
STALL_S = 10.0


@pytest.fixture(scope="module")
def oak_behaviour(tmp_path_factory):
    """What the process of the camera does from now on; see tests/drivers/fake_oak_child.py."""
    path = tmp_path_factory.mktemp("oak") / "behaviour"
    path.write_text("well")
    return path


@pytest.fixture(scope="module")
def shared(tmp_path_factory, oak_behaviour):
    """The real camera driver, and in its child's place one that breaks as it is told."""
    command = (sys.executable, str(FAKE_OAK), str(oak_behaviour))
    camera = OakCamera(OakConfig(open_timeout_s=10.0, silence_s=0.5), command)
    with served(tmp_path_factory.mktemp("data"), camera) as rig:
        rig.camera = camera
        wait_until_ready(rig.http)
        yield rig


@pytest.fixture
def rig(shared, oak_behaviour):
    yield shared
    oak_behaviour.write_text("well")
    shared.tidy_up()


@pytest.mark.parametrize(
    ("fault", "mend", "why", "held"),
    [
        ("protective_stop", "state", "ProtectiveStopError", "look for the cause"),
        ("emergency_stop", "release_emergency_stop", "EmergencyStopError", "release the button"),
        ("safeguard_stop", "close_safeguard", "SafeguardStopError", "close the safeguard"),
        ("power_off", "state", "NotPoweredError", "acknowledge to power it"),
        ("cut_link", "mend_link", "LinkLostError", "LinkLostError|NotConnectedError"),
        ("freeze", "thaw", "ControllerFrozenError", "did not confirm a stop|does not answer"),
    ],
)
def test_a_fault_of_the_arm_in_mid_move(rig, fault, mend, why, held):
    scan_id = rig.start_slowly()
    rig.wait_until_moving(scan_id)
    rig.controller.do(fault)
    status = rig.wait(scan_id, "stopped")
    assert status["detail"].startswith(why)
    before = rig.stamps(scan_id)
    assert list(before) == list(range(status["views_done"]))
    assert len(before) < 3
    rig.assert_stands_still()
    rig.assert_held(scan_id, held)
    rig.controller.do(mend)
    rig.assert_one_acknowledgement_lets_it_go_on(scan_id)
    assert before.items() <= rig.stamps(scan_id).items()


def test_a_stop_whose_cause_is_still_there_cannot_be_acknowledged(rig):
    scan_id = rig.start_slowly()
    rig.wait_until_moving(scan_id)
    rig.controller.do("emergency_stop")
    rig.wait(scan_id, "stopped")
    refused = rig.acknowledge()
    assert problem(refused, 503) == "rig_not_ready"
    assert "EmergencyStopError: emergency stop: release the button" in refused.json()["detail"]
    rig.controller.do("release_emergency_stop")
    rig.assert_one_acknowledgement_lets_it_go_on(scan_id)


def test_the_controller_is_killed_in_mid_move(rig):
    scan_id = rig.start_slowly()
    rig.wait_until_moving(scan_id)
    rig.controller.kill()
    status = rig.wait(scan_id, "stopped")
    assert status["detail"].startswith("LinkLostError")
    assert "use the emergency stop" in status["detail"]
    before = rig.stamps(scan_id)
    assert list(before) == list(range(status["views_done"]))
    try:
        gone = f"no UR controller at {rig.controller.host}.*: check address, cable and power"
        wait_for(lambda: re.search(gone, rig.part("arm")["detail"]), "it is not said to be gone")
        rig.assert_held(scan_id, gone)
        refused = rig.acknowledge()
        assert problem(refused, 503) == "rig_not_ready"
        assert re.search(gone, refused.json()["detail"])
        unheard = rig.http.post("/v1/rig:stop")
        assert problem(unheard, 503) == "rig_not_ready"
        assert "use the emergency stop" in unheard.json()["detail"]
    finally:
        rig.controller.__enter__()
    rig.assert_one_acknowledgement_lets_it_go_on(scan_id)
    assert before.items() <= rig.stamps(scan_id).items()


@pytest.mark.parametrize("sent", [signal.SIGKILL, signal.SIGSTOP])
def test_the_process_of_the_arm_driver_is_killed_or_hangs_in_mid_move(rig, sent):
    scan_id = rig.start_slowly()
    rig.wait_until_moving(scan_id)
    (child,) = processes("drivers.ur5.child")
    os.kill(child, sent)
    status = rig.wait(scan_id, "stopped")
    assert status["detail"].startswith(("DriverProcessError", "ControllerFrozenError"))
    before = rig.stamps(scan_id)
    assert list(before) == list(range(status["views_done"]))
    rig.assert_held(scan_id, "driver process|acknowledge with a reason")
    rig.assert_one_acknowledgement_lets_it_go_on(scan_id)
    assert processes("drivers.ur5.child") != [child]
    assert before.items() <= rig.stamps(scan_id).items()


@pytest.mark.parametrize("fault", ["die-once", "hang-once", "killed between two pictures"])
def test_a_camera_that_comes_back_in_time_only_delays_the_scan(rig, oak_behaviour, fault):
    scan_id = rig.start_slowly()
    rig.wait_until_moving(scan_id)
    first = rig.camera.pid
    if fault.endswith("-once"):
        oak_behaviour.write_text(fault)
    else:
        os.kill(first, signal.SIGKILL)
    assert rig.wait(scan_id, "done", "stopped")["state"] == "done"
    assert rig.camera.pid != first
    assert rig.views(scan_id) == [0, 1, 2]
    assert rig.http.get("/readyz").status_code == 200


@pytest.mark.parametrize(
    ("fault", "why"),
    [("absent", "no OAK camera found: check cable"), ("hang", "silent for 0.5 s: it hangs")],
)
def test_a_camera_that_stays_away_stops_the_scan(rig, oak_behaviour, fault, why):
    scan_id = rig.start_slowly()
    rig.wait_until_moving(scan_id)
    oak_behaviour.write_text(fault)
    os.kill(rig.camera.pid, signal.SIGKILL)
    status = rig.wait(scan_id, "stopped")
    assert status["detail"].startswith("NoCameraError")
    assert why in status["detail"]
    before = rig.stamps(scan_id)
    assert list(before) == list(range(status["views_done"]))
    rig.assert_held(scan_id, why)
    if fault == "absent":
        # The arm may be acknowledged, but without a camera nothing starts.
        assert rig.acknowledge().status_code == 200
        wait_for(lambda: why in rig.part("camera")["detail"], "the camera is said to be there")
        assert why in rig.resume(scan_id).json()["detail"]
    oak_behaviour.write_text("well")
    wait_for(lambda: rig.part("camera")["ready"], "the camera is not found again")
    rig.assert_one_acknowledgement_lets_it_go_on(scan_id)
    assert before.items() <= rig.stamps(scan_id).items()


def test_a_camera_unplugged_while_nothing_runs_is_seen_before_the_arm_moves(rig, oak_behaviour):
    oak_behaviour.write_text("absent")
    os.kill(rig.camera.pid, signal.SIGKILL)
    wait_for(lambda: not rig.part("camera")["ready"], "the camera is said to be there")
    refused = rig.post()
    assert problem(refused, 503) == "rig_not_ready"
    assert refused.json()["detail"].startswith("camera: NoCameraError")
    rig.assert_stands_still()
    oak_behaviour.write_text("well")
    wait_for(lambda: rig.part("camera")["ready"], "the camera is not found again")
    rig.wait(rig.start_slowly(), "done", views=3)


def test_a_worker_that_stalls_holds_nothing_up_and_catches_up(rig, tmp_path):
    """Stopped for ten seconds: its subscriber takes nothing, its link times out."""
    (worker,) = processes("service.worker")
    scan_id = rig.start_slowly()
    rig.wait(scan_id, "running", views=1)
    stalled = time.perf_counter()
    os.kill(worker, signal.SIGSTOP)
    try:
        rig.wait(scan_id, "done", views=3)
        assert time.perf_counter() - stalled < STALL_S
        wait_for(lambda: "silent for" in rig.part("worker")["detail"], "the worker is said to work")
        assert rig.http.get("/readyz").status_code == 200
        assert rig.views(scan_id) == [0, 1, 2]
        time.sleep(max(0.0, STALL_S - (time.perf_counter() - stalled)))
    finally:
        os.kill(worker, signal.SIGCONT)
    rig.wait_for_skeleton(scan_id, rig.replayed(scan_id, tmp_path))
    assert processes("service.worker") == [worker]
