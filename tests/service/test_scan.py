"""Scans through the real ur-rtde client against the fake controller."""

import errno
import json
import os
import re
import socket
import threading
import time
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

import httpx2
import numpy as np
import pytest
from live_rig import waypoint
from live_service import serving
from scenes.wood import view_from

from canopy_skel.geometry import invert
from canopy_skel.pipeline import MethodConfig
from canopy_skel.recording import carry_over, messages_of_view, read_recording
from drivers import kinematics
from drivers.errors import CameraTimeoutError, NotConnectedError
from drivers.guarded_arm import GuardedArm, Limits, check
from drivers.protocols import CameraImage
from drivers.ur5.arm import Ur5Arm
from drivers.ur5.dashboard import Dashboard
from drivers.ur5.messages import Ur5Config
from mock_hw.fake_ur.process import FakeUr, free_host
from mock_hw.orchard.path import TOOL_FROM_CAMERA, camera_path
from service.catalogue import Catalogue
from service.local_rig import LocalRig
from service.rig import (
    PartStatus,
    PlanRefusedError,
    RigBusyError,
    RigNotReadyError,
    ScanSpec,
    ScanState,
    UnknownScanError,
)
from service.rig_parts import RigParts

LIMITS = Limits(box_min_m=(-0.9, -0.9, -0.85), box_max_m=(0.9, 0.9, 1.1))
WAYPOINTS = tuple(pose @ invert(TOOL_FROM_CAMERA) for pose in camera_path(10))
rtde_control = pytest.importorskip("rtde_control", reason="ur-rtde has no wheel for this Python")


class StillCamera:
    """Returns the same sharp picture of the sticks; tests make it fail."""

    def __init__(self):
        self.view = view_from(0)
        self.color = np.random.default_rng(0).integers(0, 255, (240, 320, 3), np.uint8)
        self.spoiled = 0
        self.hangs = False
        self.grabs = 0
        self.stamps_ns = []

    def __enter__(self):
        return self

    def __exit__(self, *reasons):
        pass

    def check(self):
        pass

    def grab(self, timeout_s):
        self.grabs += 1
        if self.hangs:
            raise CameraTimeoutError(f"no picture within {timeout_s} s; check the cable")
        color = self.color
        if self.spoiled > 0:
            self.spoiled -= 1
            color = np.full((240, 320, 3), 128, np.uint8)
        self.stamps_ns.append(time.monotonic_ns())
        return CameraImage(
            stamp_ns=self.stamps_ns[-1],
            color_rgb=color,
            intrinsics=self.view.intrinsics,
            depth_m=self.view.depth_m,
            instances=self.view.instances,
            scores=self.view.scores,
        )


class Collected:
    """A feed that remembers."""

    def __init__(self):
        self.offered = []
        self.messages = {}

    def begin(self, spec, path):
        pass

    def catch_up(self, spec, path):
        pass

    def offer(self, scan_id, index, messages):
        self.offered.append(index)
        self.messages[scan_id, index] = messages

    def skeleton(self, scan_id):
        return None

    def worker(self):
        return PartStatus(name="worker", ready=True)

    def flush(self, timeout_s):
        return True


@pytest.fixture(scope="module")
def controller():
    with FakeUr(free_host(), time_scale=20) as running:
        yield running


@pytest.fixture
def fake(controller):
    controller.do("home")
    yield controller
    controller.do("reset")
    time.sleep(0.03)


@pytest.fixture
def camera():
    return StillCamera()


@pytest.fixture
def rig(fake, camera, tmp_path):
    # The watchdog is too slow to stop anything in place of the scan.
    config = Ur5Config(host=fake.host, script_timeout_s=0.5, watchdog_hz=0.2)
    arm = GuardedArm(Ur5Arm(config), LIMITS)
    parts = RigParts(
        arm=arm,
        camera=camera,
        limits=LIMITS,
        tool_from_camera=TOOL_FROM_CAMERA,
        feed=Collected(),
        data=tmp_path,
        attachments=lambda exposed_ns: {"exposed.json": json.dumps(exposed_ns).encode()},
    )
    with LocalRig(parts) as running:
        running.events = []
        running.subscribe(lambda event: running.events.append((event.kind, dict(event.fields))))
        running.feed = parts.feed
        yield running


def spec(scan_id="scan-1", waypoints=WAYPOINTS[:4], **changes):
    return ScanSpec(
        scan_id=scan_id, tree_id="t1", waypoints=waypoints, config=MethodConfig(), **changes
    )


def wait_for(rig, scan_id, *states, timeout_s=30.0):
    until = time.perf_counter() + timeout_s
    while rig.status(scan_id).state not in states:
        assert time.perf_counter() < until, rig.status(scan_id)
        time.sleep(0.01)
    return rig.status(scan_id)


def wait_until_moving(rig, controller):
    before = controller.do("state")["joints_rad"]
    until = time.perf_counter() + 10
    while np.allclose(controller.do("state")["joints_rad"], before, atol=1e-4):
        assert time.perf_counter() < until


def assert_stands_still(controller):
    """Once the brakes have done their work, nothing moves."""
    until = time.perf_counter() + 2
    while controller.do("state")["moving"]:
        assert time.perf_counter() < until
        time.sleep(0.01)
    joints = controller.do("state")["joints_rad"]
    time.sleep(0.3)
    assert controller.do("state")["joints_rad"] == joints


def views_of(rig, scan_id):
    return list(read_recording(rig.recording_path(scan_id)).views())


def test_a_scan_visits_its_waypoints_and_records_what_it_saw(rig, fake):
    status = rig.start(spec())
    assert (status.state, status.views_total) == (ScanState.RUNNING, 4)
    assert wait_for(rig, "scan-1", ScanState.DONE).views_done == 4
    recording = read_recording(rig.recording_path("scan-1"))
    views = list(recording.views())
    assert [view.index for view in views] == [0, 1, 2, 3]
    for view, pose in zip(views, camera_path(10), strict=False):
        np.testing.assert_allclose(view.base_from_camera, pose, atol=2e-4)
        assert abs(view.stamp_ns - time.time_ns()) < 60e9
    assert rig.feed.offered == [0, 1, 2, 3]
    for index in range(4):  # nobody has to read them again
        assert rig.feed.messages["scan-1", index] == messages_of_view(recording, index)
    assert [kind for kind, _ in rig.events].count("view") == 4
    assert rig.events[-1][0] == "done"
    assert recording.metadata["tree_id"] == "t1"


def test_a_paused_scan_stands_still_and_goes_on_where_it_was(rig, fake):
    rig.start(spec())
    while rig.status("scan-1").views_done < 1:
        time.sleep(0.005)
    assert rig.pause("scan-1").state is ScanState.PAUSED
    done = rig.status("scan-1").views_done
    assert_stands_still(fake)
    assert rig.status("scan-1").views_done == done < 4
    rig.resume("scan-1")
    assert wait_for(rig, "scan-1", ScanState.DONE).views_done == 4
    assert [view.index for view in views_of(rig, "scan-1")] == [0, 1, 2, 3]
    assert sorted(path.name for path in rig.recording_path("scan-1").parent.iterdir()) == [
        "scan-1.mcap"
    ]


def exposed_of(rig, scan_id):
    return json.loads(read_recording(rig.recording_path(scan_id)).attachment("exposed.json"))


def test_what_is_attached_is_of_the_pictures_in_the_recording_alone(rig, camera):
    rig.start(spec())
    wait_for(rig, "scan-1", ScanState.DONE)
    camera.spoiled = 1
    rig.start(spec("scan-2"))
    while rig.status("scan-2").views_done < 2:
        time.sleep(0.005)
    rig.pause("scan-2")
    rig.resume("scan-2")
    wait_for(rig, "scan-2", ScanState.DONE)
    assert exposed_of(rig, "scan-1") == camera.stamps_ns[:4]
    kept = set(exposed_of(rig, "scan-2"))
    assert len(kept) == 4
    assert kept <= set(camera.stamps_ns[5:])  # the fifth was spoiled


def test_ending_a_scan_that_rests_leaves_the_one_under_way_alone(rig, fake):
    rig.start(spec("scan-1"))
    while rig.status("scan-1").views_done < 1:
        time.sleep(0.005)
    rig.pause("scan-1")
    rig.start(spec("scan-2"))
    for _ in range(3):
        wait_until_moving(rig, fake)
        rig.pause("scan-1")
    assert rig.cancel("scan-1").state is ScanState.CANCELLED
    assert wait_for(rig, "scan-2", ScanState.DONE, ScanState.STOPPED).state is ScanState.DONE


def test_views_of_another_hand_eye_calibration_are_not_gone_on_with(fake, camera, tmp_path):
    def rig_with(tool_from_camera):
        arm = GuardedArm(Ur5Arm(Ur5Config(host=fake.host, watchdog_hz=0.2)), LIMITS)
        return LocalRig(
            RigParts(
                arm=arm,
                camera=camera,
                limits=LIMITS,
                tool_from_camera=tool_from_camera,
                feed=Collected(),
                data=tmp_path,
            )
        )

    with rig_with(TOOL_FROM_CAMERA) as rig:
        rig.start(spec())
        while rig.status("scan-1").views_done < 2:
            time.sleep(0.005)
        rig.pause("scan-1")
    moved = TOOL_FROM_CAMERA.copy()
    moved[0, 3] += 0.01
    with rig_with(moved) as rig:
        rig.start(spec(), views_before=2)
        status = wait_for(rig, "scan-1", ScanState.DONE, ScanState.STOPPED)
        assert "begun with another tool_from_camera" in status.detail
    with rig_with(TOOL_FROM_CAMERA) as rig:
        rig.start(spec(), views_before=2)
        wait_for(rig, "scan-1", ScanState.DONE)
        assert len(views_of(rig, "scan-1")) == 4


def test_pictures_of_an_earlier_life_are_said_not_to_be_known(rig, tmp_path):
    rig.start(spec())
    while rig.status("scan-1").views_done < 1:
        time.sleep(0.005)
    rig.pause("scan-1")
    part = rig.recording_path("scan-1")
    other = tmp_path / "scans" / "scan-2" / "scan-2.mcap.part"
    other.parent.mkdir()
    part.rename(other)  # as a service finds it that has just been started
    rig.start(spec("scan-2"), views_before=1)
    wait_for(rig, "scan-2", ScanState.DONE)
    assert exposed_of(rig, "scan-2") is None


def test_a_cancelled_scan_keeps_its_views_and_does_not_go_on(rig):
    rig.start(spec())
    while rig.status("scan-1").views_done < 1:
        time.sleep(0.005)
    assert rig.cancel("scan-1").state is ScanState.CANCELLED
    assert len(views_of(rig, "scan-1")) >= 1
    with pytest.raises(RigNotReadyError, match="is cancelled"):
        rig.resume("scan-1")


def test_a_scan_that_is_done_is_not_cancelled_any_more(rig):
    rig.start(spec())
    wait_for(rig, "scan-1", ScanState.DONE)
    assert rig.cancel("scan-1").state is ScanState.DONE
    assert rig.status("scan-1").state is ScanState.DONE


@pytest.mark.parametrize("step", ["rename", "unlink", "exists"])
def test_a_disk_that_went_read_only_stops_the_scan_and_costs_nothing(rig, monkeypatch, step):
    rig.start(spec())
    while rig.status("scan-1").views_done < 1:
        time.sleep(0.005)
    before = rig.pause("scan-1").views_done

    def refused(path, *more, **options):
        raise OSError(errno.EROFS, "Read-only file system")

    with monkeypatch.context() as disk:
        disk.setattr(Path, step, refused)
        rig.resume("scan-1")
        until = time.perf_counter() + 10
        while rig.status("scan-1").state is ScanState.RUNNING:
            assert time.perf_counter() < until
        detail = rig.status("scan-1").detail
        assert rig.status("scan-1").state is ScanState.STOPPED
    assert "Read-only file system" in detail
    assert step == "exists" or re.search(r"/scan-1\.mcap\S*: cannot be written .* check", detail)
    with pytest.raises(RigNotReadyError, match="acknowledge"):
        rig.resume("scan-1")
    rig.acknowledge("remounted")
    rig.resume("scan-1")
    assert wait_for(rig, "scan-1", ScanState.DONE).views_done == 4
    assert len(views_of(rig, "scan-1")) == 4 > before


def test_a_folder_that_went_away_makes_the_disk_not_ready(rig, tmp_path, monkeypatch):
    monkeypatch.setattr("shutil.disk_usage", lambda path: Path("/nowhere/at/all").stat())
    part = {part.name: part for part in rig.parts()}["disk"]
    assert not part.ready
    assert f"{tmp_path}: cannot be written (No such file or directory); check" in part.detail


def test_a_second_scan_is_refused(rig):
    rig.start(spec())
    with pytest.raises(RigBusyError, match="scan scan-1 is under way"):
        rig.start(spec("scan-2"))
    wait_for(rig, "scan-1", ScanState.DONE)


def test_the_operators_stop_needs_an_acknowledgement(rig, fake):
    rig.start(spec())
    wait_until_moving(rig, fake)
    rig.stop()
    assert wait_for(rig, "scan-1", ScanState.STOPPED)
    with pytest.raises(RigNotReadyError, match="acknowledge"):
        rig.resume("scan-1")
    with pytest.raises(RigNotReadyError, match="acknowledge"):
        rig.start(spec("scan-2"))
    assert_stands_still(fake)
    rig.acknowledge("looked, nobody near")
    rig.resume("scan-1")
    assert wait_for(rig, "scan-1", ScanState.DONE).views_done == 4


def test_a_stop_while_a_scan_is_planned_keeps_it_from_beginning(rig, fake, monkeypatch):
    plan = rig.plan

    def stopped_meanwhile(spec):
        rig.stop()
        return plan(spec)

    with monkeypatch.context() as patched:
        patched.setattr(rig, "plan", stopped_meanwhile)
        with pytest.raises(RigNotReadyError, match="stopped by the operator"):
            rig.start(spec())
    assert_stands_still(fake)
    with pytest.raises(UnknownScanError):
        rig.status("scan-1")
    rig.acknowledge("looked")
    rig.start(spec())
    assert wait_for(rig, "scan-1", ScanState.DONE).views_done == 4


def test_a_stop_while_a_move_is_being_begun_keeps_it_from_beginning(rig, fake, monkeypatch):
    uploading, prepare = threading.Event(), Ur5Arm._prepare

    def slowly(arm, sample):
        uploading.set()
        time.sleep(0.5)
        prepare(arm, sample)

    monkeypatch.setattr(Ur5Arm, "_prepare", slowly)
    before = fake.do("state")["joints_rad"]
    rig.start(spec())
    assert uploading.wait(5.0)
    rig.stop()
    assert wait_for(rig, "scan-1", ScanState.STOPPED).views_done == 0
    assert fake.do("state")["joints_rad"] == before
    assert_stands_still(fake)


class BlockedCamera:
    """Lets the first picture wait, as while the camera's process is replaced."""

    def __init__(self, camera):
        self._grab, self.waiting, self.there = camera.grab, threading.Event(), threading.Event()
        camera.grab = self.grab

    def grab(self, timeout_s):
        self.waiting.set()
        assert self.there.wait(timeout_s)
        return self._grab(timeout_s)


def open_and_close_the_door(rig, fake):
    fake.do("safeguard_stop")
    while "safeguard" not in rig.parts()[0].detail:
        time.sleep(0.01)
    fake.do("close_safeguard")
    while "not acknowledged" not in rig.parts()[0].detail:
        time.sleep(0.01)


def start_over_http(http, **changes):
    poses = [waypoint(pose) for pose in WAYPOINTS[:4]]
    body = {"tree_id": "t1", "waypoints": poses, "segmenter": "recorded", **changes}
    answer = http.post("/v1/scans", json=body, headers={"Idempotency-Key": "k"})
    assert answer.status_code == 202, answer.text
    return answer.json()["scan_id"]


def acknowledge(http):
    return http.post("/v1/rig:acknowledge", json={"reason": "all out, way is clear"})


def test_an_acknowledgement_alone_moves_nothing(rig, fake, camera, tmp_path):
    """The door opens and closes again while a scan waits for its camera, and never meets it."""
    blocked = BlockedCamera(camera)
    with serving(tmp_path / "state", rig) as live:
        scan_id = start_over_http(live.http)
        assert blocked.waiting.wait(20.0)
        open_and_close_the_door(rig, fake)
        before = fake.do("state")["joints_rad"]
        threading.Timer(0.3, blocked.there.set).start()
        assert acknowledge(live.http).status_code == 200
        status = wait_for(rig, scan_id, ScanState.STOPPED, ScanState.DONE)
        assert (status.state, status.views_done) == (ScanState.STOPPED, 1)
        assert "not acknowledged: safeguard stop" in status.detail
        assert_stands_still(fake)
        assert fake.do("state")["joints_rad"] == before
        assert live.http.post(f"/v1/scans/{scan_id}:resume").status_code == 200
        assert wait_for(rig, scan_id, ScanState.DONE, ScanState.STOPPED).state is ScanState.DONE
    with Catalogue(tmp_path / "state") as catalogue:
        assert catalogue.last_stop() == 0


def test_an_acknowledgement_is_refused_until_the_scan_has_ended(rig, fake, camera, monkeypatch):
    blocked = BlockedCamera(camera)
    rig.start(spec())
    assert blocked.waiting.wait(20.0)
    open_and_close_the_door(rig, fake)
    with monkeypatch.context() as patched:
        patched.setattr("service.local_rig.STOP_TIMEOUT_S", 0.2)
        with pytest.raises(RigNotReadyError, match="the scan has not ended within"):
            rig.acknowledge("all out")
    blocked.there.set()
    assert wait_for(rig, "scan-1", ScanState.STOPPED).views_done == 1
    assert_stands_still(fake)
    rig.acknowledge("all out")
    rig.resume("scan-1")
    assert wait_for(rig, "scan-1", ScanState.DONE, ScanState.STOPPED).state is ScanState.DONE


def test_no_picture_is_taken_again_while_the_arm_is_held(rig, fake, camera, monkeypatch):
    grab = camera.grab

    def meanwhile(timeout_s):
        fake.do("safeguard_stop")
        while rig.parts()[0].ready:
            time.sleep(0.01)
        return grab(timeout_s)

    monkeypatch.setattr(camera, "grab", meanwhile)
    camera.spoiled = 99
    rig.start(spec())
    assert "SafeguardStopError" in wait_for(rig, "scan-1", ScanState.STOPPED).detail
    assert camera.grabs == 1


def acknowledge_a_door(rig, fake):
    open_and_close_the_door(rig, fake)
    rig.acknowledge("all out, way is clear")


@pytest.mark.parametrize(
    ("meanwhile", "state", "why"),
    [
        (lambda rig, fake: rig.pause("scan-1"), ScanState.PAUSED, "was paused or cancelled"),
        (lambda rig, fake: rig.cancel("scan-1"), ScanState.CANCELLED, "was paused or cancelled"),
        (acknowledge_a_door, ScanState.PAUSED, "arm: it was stopped meanwhile"),
    ],
)
def test_a_resume_that_waits_for_the_camera_can_be_called_off(
    rig, fake, camera, meanwhile, state, why
):
    rig.start(spec())
    while rig.status("scan-1").views_done < 1:
        time.sleep(0.005)
    rig.pause("scan-1")
    waiting, there, refusals = threading.Event(), threading.Event(), []

    def opening():
        if threading.current_thread() is resuming:
            waiting.set()
            assert there.wait(5.0)

    def resume():
        with pytest.raises(RigNotReadyError) as refused:
            rig.resume("scan-1")
        refusals.append(str(refused.value))

    camera.check = opening
    resuming = threading.Thread(target=resume)
    resuming.start()
    assert waiting.wait(5.0)
    meanwhile(rig, fake)
    assert rig.status("scan-1").state is state
    there.set()
    resuming.join(5.0)
    assert len(refusals) == 1
    assert why in refusals[0]
    assert rig.status("scan-1").state is state
    assert_stands_still(fake)


def test_a_stop_that_fails_while_a_move_is_being_begun_is_made_good(rig, fake, monkeypatch):
    """The arm cannot be told in the one moment in which there is nothing to stop yet."""
    beginning, unheard, stop = threading.Event(), threading.Event(), Ur5Arm.stop

    def slowly(*arguments):
        beginning.set()
        assert unheard.wait(5.0)
        check(*arguments)

    def not_at_first(arm):
        if not unheard.is_set():
            unheard.set()
            raise NotConnectedError("stop not confirmed: use the emergency stop")
        stop(arm)

    monkeypatch.setattr("drivers.guarded_arm.check", slowly)
    monkeypatch.setattr(Ur5Arm, "stop", not_at_first)
    before = fake.do("state")["joints_rad"]
    rig.start(spec(speed_mps=0.005))
    assert beginning.wait(5.0)
    with pytest.raises(RigNotReadyError, match="use the emergency stop"):
        rig.stop()
    assert wait_for(rig, "scan-1", ScanState.STOPPED).views_done == 0
    assert_stands_still(fake)
    np.testing.assert_allclose(fake.do("state")["joints_rad"], before, atol=0.02)


def test_a_scan_that_cannot_begin_leaves_the_rig_free(rig, tmp_path):
    (tmp_path / "scans").write_bytes(b"no folder")
    with pytest.raises(RigNotReadyError, match=r"disk: .*scan-1: cannot be written .* check the"):
        rig.start(spec())
    (tmp_path / "scans").unlink()
    rig.start(spec("scan-2"))
    assert wait_for(rig, "scan-2", ScanState.DONE).views_done == 4


def test_a_stop_during_an_acknowledgement_wants_one_of_its_own(rig, fake, monkeypatch):
    rig.stop()
    arm = rig._parts.arm
    acknowledge = arm.acknowledge

    def stopped_meanwhile(reason):
        acknowledge(reason)
        rig.stop()

    with monkeypatch.context() as patched:
        patched.setattr(arm, "acknowledge", stopped_meanwhile)
        rig.acknowledge("looked, nobody near")
    with pytest.raises(RigNotReadyError, match="stopped by the operator"):
        rig.start(spec())
    rig.acknowledge("looked again")
    rig.start(spec())
    wait_for(rig, "scan-1", ScanState.DONE)


@pytest.mark.parametrize(
    ("fault", "says"),
    [("protective_stop", "ProtectiveStopError"), ("emergency_stop", "EmergencyStopError")],
)
def test_a_safety_stop_in_mid_move_loses_nothing_and_moves_nothing(rig, fake, fault, says):
    rig.start(spec())
    while rig.status("scan-1").views_done < 1:
        time.sleep(0.005)
    wait_until_moving(rig, fake)
    fake.do(fault)
    status = wait_for(rig, "scan-1", ScanState.STOPPED)
    assert says in status.detail
    with pytest.raises(RigNotReadyError):
        rig.resume("scan-1")
    assert_stands_still(fake)
    assert Dashboard(fake.host).ask("play") == "Failed to execute: play"
    assert len(views_of(rig, "scan-1")) == status.views_done >= 1


def test_a_hanging_camera_stops_the_scan_and_it_can_go_on(rig, camera):
    rig.start(spec())
    while rig.status("scan-1").views_done < 1:
        time.sleep(0.005)
    camera.hangs = True
    status = wait_for(rig, "scan-1", ScanState.STOPPED)
    assert "CameraTimeoutError: no picture within" in status.detail
    camera.hangs = False
    with pytest.raises(RigNotReadyError, match=r"no picture within .* acknowledge with a reason"):
        rig.resume("scan-1")
    rig.acknowledge("plugged in again")
    rig.resume("scan-1")
    assert wait_for(rig, "scan-1", ScanState.DONE).views_done == 4


def test_a_scan_that_lost_the_arm_does_not_stop_who_has_it_now(rig, fake, camera, monkeypatch):
    others = []

    def lost_meanwhile(timeout_s):
        fake.do("cut_link")
        while rig.parts()[0].ready:
            time.sleep(0.01)
        fake.do("mend_link")
        others.append(rtde_control.RTDEControlInterface(fake.host))
        x, y, z, *turn = fake.do("state")["tcp_pose"]
        assert others[0].moveL([x, y, z - 0.2, *turn], 0.001, 0.5, True)
        while "ArmTakenError" not in rig.parts()[0].detail:
            time.sleep(0.01)
        raise CameraTimeoutError(f"no picture within {timeout_s} s; check the cable")

    monkeypatch.setattr(camera, "grab", lost_meanwhile)
    rig.start(spec())
    assert "CameraTimeoutError" in wait_for(rig, "scan-1", ScanState.STOPPED).detail
    assert fake.do("state")["moving"]
    assert others[0].isProgramRunning()
    rig.stop()
    assert_stands_still(fake)
    others[0].disconnect()


def test_a_scan_that_fails_does_not_stop_a_program_that_is_not_its_own(rig, fake, camera):
    def replaced_meanwhile(timeout_s):
        Dashboard(fake.host).ask("stop")
        while rig.parts()[0].ready:
            time.sleep(0.01)
        x, y, z, *turn = fake.do("state")["tcp_pose"]
        errand = f"def errand():\n  movel(p{[x, y, z - 0.2, *turn]}, a=0.5, v=0.001)\nend\n"
        with socket.create_connection((fake.host, 30002)) as link:
            link.sendall(errand.encode())
            wait_until_moving(rig, fake)
        raise CameraTimeoutError(f"no picture within {timeout_s} s; check the cable")

    camera.grab = replaced_meanwhile
    rig.start(spec())
    assert "CameraTimeoutError" in wait_for(rig, "scan-1", ScanState.STOPPED).detail
    time.sleep(0.1)
    assert fake.do("state")["moving"]
    rig.stop()
    assert_stands_still(fake)


def test_a_controller_that_was_silent_for_a_moment_does_not_finish_its_move(rig, fake):
    rig.start(spec(waypoints=WAYPOINTS[-1:], speed_mps=0.005))
    wait_until_moving(rig, fake)
    fake.do("freeze")
    time.sleep(0.4)
    fake.do("thaw")
    status = wait_for(rig, "scan-1", ScanState.STOPPED)
    assert "ControllerFrozenError" in status.detail
    assert_stands_still(fake)
    with pytest.raises(RigNotReadyError, match="acknowledge"):
        rig.resume("scan-1")
    rig.acknowledge("looked")
    assert_stands_still(fake)


def test_a_slow_move_is_waited_for(rig):
    """The time to settle begins when the move should have ended."""
    began_s = time.perf_counter()
    rig.start(spec(waypoints=WAYPOINTS[-1:], speed_mps=0.02, settle_timeout_s=0.2))
    status = wait_for(rig, "scan-1", ScanState.DONE, ScanState.STOPPED)
    assert (status.state, status.detail) == (ScanState.DONE, "")
    assert time.perf_counter() - began_s > 0.4


def test_a_move_that_does_not_end_is_stopped(rig, fake, monkeypatch):
    near = kinematics.forward(fake.do("state")["joints_rad"])
    near[2, 3] -= 0.05
    arm = rig._parts.arm
    start_move = arm.start_move
    monkeypatch.setattr(arm, "start_move", lambda move: start_move(replace(move, speed_mps=1e-4)))
    rig.start(spec(waypoints=(near,), settle_timeout_s=0.2))
    status = wait_for(rig, "scan-1", ScanState.DONE, ScanState.STOPPED)
    assert status.state is ScanState.STOPPED
    assert re.search(r"SettleTimeoutError: the arm did not come to rest within \d+", status.detail)
    assert_stands_still(fake)


def test_a_bad_picture_is_taken_again(rig, camera):
    camera.spoiled = 2
    rig.start(spec(waypoints=WAYPOINTS[:1]))
    wait_for(rig, "scan-1", ScanState.DONE)
    assert camera.grabs == 3
    retakes = [fields for kind, fields in rig.events if kind == "retake"]
    assert [fields["index"] for fields in retakes] == [0, 0]
    assert "blurred" in retakes[0]["reasons"][0]


def test_a_waypoint_without_a_good_picture_stops_the_scan(rig, camera):
    camera.spoiled = 99
    rig.start(spec(waypoints=WAYPOINTS[:1]))
    status = wait_for(rig, "scan-1", ScanState.STOPPED)
    assert "waypoint 0: blurred" in status.detail
    assert "resume" in status.detail


def test_unreachable_waypoints_are_refused_before_anything_moves(rig, fake):
    far = WAYPOINTS[0].copy()
    far[:3, 3] = (3.0, 0.0, 0.5)
    joints = fake.do("state")["joints_rad"]
    with pytest.raises(PlanRefusedError, match="waypoint 1") as refused:
        rig.start(spec(waypoints=(WAYPOINTS[0], far, WAYPOINTS[1])))
    assert [verdict.reachable for verdict in refused.value.verdicts] == [True, False, True]
    assert fake.do("state")["joints_rad"] == joints
    with pytest.raises(UnknownScanError):
        rig.status("scan-1")


def test_what_a_killed_service_left_is_carried_on(rig):
    """The `.part` file is all there is; starting the scan anew goes on with it."""
    rig.start(spec())
    while rig.status("scan-1").views_done < 2:
        time.sleep(0.005)
    rig.pause("scan-1")
    before = {v.index: v.depth_m.tobytes() for v in views_of(rig, "scan-1")}
    rig.start(spec())
    wait_for(rig, "scan-1", ScanState.DONE)
    after = {v.index: v.depth_m.tobytes() for v in views_of(rig, "scan-1")}
    assert set(after) == {0, 1, 2, 3}
    assert all(after[index] == data for index, data in before.items())


def test_what_was_set_aside_is_gone_for_good_before_more_is_recorded(rig, camera, monkeypatch):
    """A power cut undoes what was not synced; the name of a file is synced with its folder."""
    rig.start(spec())
    while rig.status("scan-1").views_done < 1:
        time.sleep(0.005)
    rig.pause("scan-1")
    folder, synced_names, sync = rig.recording_path("scan-1").parent, [], os.fsync

    def synced(descriptor):
        sync(descriptor)
        if os.path.samestat(os.fstat(descriptor), folder.stat()):
            names = {path.suffix for path in folder.iterdir()}
            synced_names.append((names, camera.grabs))

    grabs = camera.grabs
    monkeypatch.setattr(os, "fsync", synced)
    rig.resume("scan-1")
    assert wait_for(rig, "scan-1", ScanState.DONE).views_done == 4
    # The new file's name first, or there might be neither.
    assert synced_names[:2] == [({".aside", ".part"}, grabs), ({".part"}, grabs)]


def test_the_count_of_views_never_falls_while_a_scan_is_taken_up_again(rig, monkeypatch):
    rig.start(spec())
    while rig.status("scan-1").views_done < 2:
        time.sleep(0.005)
    before = rig.pause("scan-1").views_done
    reading, read = threading.Event(), threading.Event()

    def slowly(*arguments):
        reading.set()
        assert read.wait(5.0)
        return carry_over(*arguments)

    monkeypatch.setattr("service.scan.carry_over", slowly)
    assert rig.resume("scan-1").views_done == before
    assert reading.wait(5.0)
    assert rig.status("scan-1").views_done == before
    read.set()
    assert wait_for(rig, "scan-1", ScanState.DONE).views_done == 4


def test_the_count_of_an_earlier_life_holds_until_the_recording_has_been_read(rig):
    assert rig.start(spec(), views_before=3).views_done == 3
    assert wait_for(rig, "scan-1", ScanState.DONE).views_done == 4


def test_a_scan_whose_recording_is_whole_is_done_without_a_move(rig, fake):
    """The service was killed between the end of the recording and saying so."""
    rig.start(spec())
    wait_for(rig, "scan-1", ScanState.DONE)
    before = fake.do("state")["joints_rad"], rig.recording_path("scan-1").read_bytes()
    rig.feed.offered.clear()
    rig.start(spec())
    assert wait_for(rig, "scan-1", ScanState.DONE).views_done == 4
    assert rig.feed.offered == [0, 1, 2, 3]
    assert (fake.do("state")["joints_rad"], rig.recording_path("scan-1").read_bytes()) == before


def test_stop_from_another_thread_ends_motion_at_once(rig, fake):
    rig.start(spec(waypoints=WAYPOINTS))
    wait_until_moving(rig, fake)
    stopper = threading.Thread(target=rig.stop)
    stopper.start()
    stopper.join(2.0)
    assert not stopper.is_alive()
    wait_for(rig, "scan-1", ScanState.STOPPED)
    assert_stands_still(fake)


def test_the_arm_stands_before_the_service_stops_answering(rig, fake, camera, tmp_path):
    """Its camera keeps the scan from ending for a while; the service can be asked all along."""
    blocked, service = BlockedCamera(camera), ExitStack()
    live = service.enter_context(serving(tmp_path / "state", rig))
    scan_id = start_over_http(live.http)
    assert blocked.waiting.wait(20.0)
    ending = threading.Thread(target=service.close)
    ending.start()
    time.sleep(0.5)
    assert httpx2.post(f"{live.url}/v1/rig:stop").status_code == 200
    blocked.there.set()
    ending.join(10.0)
    assert not ending.is_alive()
    assert rig.status(scan_id).state is ScanState.PAUSED
    with Catalogue(tmp_path / "state") as catalogue:
        assert catalogue.scan(scan_id).state is ScanState.PAUSED
    with pytest.raises(httpx2.ConnectError):
        httpx2.post(f"{live.url}/v1/rig:stop")


def test_a_service_that_ends_stops_the_arm_itself(rig, fake, tmp_path):
    """The server has ended, arm and camera are open still: nothing else has stopped the arm."""
    with serving(tmp_path / "state", rig) as live:
        scan_id = start_over_http(live.http, speed_mps=0.005)
        wait_until_moving(rig, fake)
    assert rig.status(scan_id).state is ScanState.PAUSED
    assert_stands_still(fake)
    with pytest.raises(RigNotReadyError, match="the service is ending"):
        rig.resume(scan_id)
