"""The unmodified ur-rtde client library against the fake controller."""

import time
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest

from drivers import kinematics
from mock_hw.fake_ur.controller import HOME_RAD
from mock_hw.fake_ur.process import FakeUr

NO_WHEEL = "ur-rtde has no wheel for this Python"
dashboard_client = pytest.importorskip("dashboard_client", reason=NO_WHEEL)
rtde_control = pytest.importorskip("rtde_control", reason=NO_WHEEL)
rtde_io = pytest.importorskip("rtde_io", reason=NO_WHEEL)
rtde_receive = pytest.importorskip("rtde_receive", reason=NO_WHEEL)

HOME = list(HOME_RAD)


@dataclass
class Client:
    fake: FakeUr
    control: Any
    receive: Any
    io: Any

    def catch_up(self):
        """Wait for packages that are newer than what the controller does now."""
        stamp_s = self.fake.do("state")["stamp_s"]
        wait_until(lambda: self.receive.getTimestamp() > stamp_s)


@pytest.fixture(scope="module")
def shared_client(shared_fake):
    host = shared_fake.host
    flags = rtde_control.RTDEControlInterface.FLAG_UPLOAD_SCRIPT
    client = Client(
        fake=shared_fake,
        control=rtde_control.RTDEControlInterface(host, -1.0, flags),
        receive=rtde_receive.RTDEReceiveInterface(host),
        io=rtde_io.RTDEIOInterface(host),
    )
    yield client
    for interface in (client.io, client.control, client.receive):
        interface.disconnect()


@pytest.fixture
def client(shared_client, fake):
    """Connected, program running, at home, no tool."""
    control = shared_client.control
    if not control.isProgramRunning():
        control.reuploadScript()
        wait_until(control.isProgramRunning)
    shared_client.io.setSpeedSlider(1.0)
    assert control.setTcp([0.0] * 6)
    assert control.moveJ(HOME, 3.0, 10.0)
    shared_client.catch_up()
    return shared_client


@pytest.fixture
def dashboard(fake):
    connected = dashboard_client.DashboardClient(fake.host)
    connected.connect()
    yield connected
    connected.disconnect()


def wait_until(condition, timeout_s=3.0):
    until = time.perf_counter() + timeout_s
    while not condition():
        assert time.perf_counter() < until
        time.sleep(0.002)


def running(client):
    return client.control.getAsyncOperationProgressEx().isAsyncOperationRunning()


def shifted(client, dx=0.0, dy=0.0, dz=0.0):
    pose = client.receive.getActualTCPPose()
    return [pose[0] + dx, pose[1] + dy, pose[2] + dz, *pose[3:]]


def record(client):
    """Poses and speeds of every package until the move under way ends."""
    stamps, poses, speeds = [], [], []
    wait_until(lambda: running(client))
    while running(client):
        stamp = client.receive.getTimestamp()
        pose, speed = client.receive.getActualTCPPose(), client.receive.getActualTCPSpeed()
        if client.receive.getTimestamp() == stamp and stamps[-1:] != [stamp]:
            stamps.append(stamp)
            poses.append(pose)
            speeds.append(speed)
    return np.array(stamps), np.array(poses), np.array(speeds)


def test_it_takes_the_client_for_a_controller_of_its_generation(client, dashboard, version):
    assert dashboard.polyscopeVersion().startswith(version)
    assert client.receive.getRobotMode() == 7
    assert client.receive.getSafetyMode() == 1
    assert client.control.isProgramRunning()
    assert dashboard.running()
    assert dashboard.programState().startswith("PLAYING")


def test_blocking_moves_arrive(client):
    target = [q + d for q, d in zip(HOME, [0.4, 0.1, -0.2, 0.3, 0.2, -1.0], strict=True)]
    assert client.control.moveJ(target, 1.05, 1.4)
    client.catch_up()
    assert client.receive.getActualQ() == pytest.approx(target, abs=1e-9)

    pose = shifted(client, dx=0.05, dy=-0.03, dz=0.04)
    assert client.control.moveL(pose, 0.25, 0.5)
    client.catch_up()
    assert client.receive.getActualTCPPose()[:3] == pytest.approx(pose[:3], abs=1e-8)
    assert client.receive.getActualTCPSpeed() == [0.0] * 6


def test_a_linear_move_is_straight_and_never_faster_than_asked(client):
    start = np.array(client.receive.getActualTCPPose()[:3])
    pose = shifted(client, dx=-0.05, dy=0.2, dz=-0.2)
    assert client.control.moveL(pose, 0.05, 0.5, True)
    stamps, poses, speeds = record(client)

    way = np.array(pose[:3]) - start
    along = (poses[:, :3] - start) @ way / (way @ way)
    aside = np.linalg.norm(poses[:, :3] - start - along[:, None] * way, axis=1)
    assert len(stamps) > 20
    assert aside.max() < 1e-8
    assert (np.diff(along) >= -1e-12).all()
    speed = np.linalg.norm(speeds[:, :3], axis=1)
    assert speed.max() == pytest.approx(0.05, rel=1e-3)


def test_a_path_reports_its_waypoints(client):
    a, b = shifted(client, dz=-0.05), shifted(client, dy=0.05)
    # Slow enough for a busy machine to see every leg.
    path = [[*pose, 0.03, 0.5, 0.0] for pose in (a, b, a, b)]
    assert client.control.moveL(path, True)
    seen = []
    wait_until(lambda: running(client))
    while running(client):
        progress = client.control.getAsyncOperationProgress()
        if progress >= 0 and progress not in seen:
            seen.append(progress)
    assert seen == [0, 1, 2, 3]
    client.catch_up()
    assert client.receive.getActualTCPPose()[:3] == pytest.approx(b[:3], abs=1e-5)


@pytest.mark.parametrize("stop", ["stopL", "stopJ"])
def test_a_stopped_move_stays_stopped(client, stop):
    target = shifted(client, dz=-0.3)
    assert client.control.moveL(target, 0.05, 0.5, True)
    wait_until(lambda: abs(client.receive.getActualTCPSpeed()[2]) > 0.04)
    getattr(client.control, stop)(2.0)
    client.catch_up()
    rest = client.receive.getActualTCPPose()
    assert target[2] + 0.05 < rest[2]
    assert client.control.isSteady()
    time.sleep(0.1)
    assert client.receive.getActualTCPPose() == rest


def test_a_move_during_an_asynchronous_stop_ends_the_program(client):
    assert client.control.moveL(shifted(client, dz=-0.3), 0.05, 0.5, True)
    wait_until(lambda: abs(client.receive.getActualTCPSpeed()[2]) > 0.04)
    client.control.stopL(0.01, True)
    assert not client.control.moveJ(HOME, 1.0, 1.0)
    wait_until(lambda: not client.control.isProgramRunning())


def test_the_speed_slider_slows_the_clock_of_the_motion(client):
    def speed_with(slider):
        client.io.setSpeedSlider(slider)
        wait_until(lambda: client.receive.getTargetSpeedFraction() == slider)
        assert client.control.moveL(shifted(client, dz=-0.1), 0.02, 0.5, True)
        stamps, poses, _ = record(client)
        client.control.moveJ(HOME, 3.0, 10.0)
        half = len(stamps) // 4, -len(stamps) // 4
        return (poses[half[1], 2] - poses[half[0], 2]) / (stamps[half[1]] - stamps[half[0]])

    assert speed_with(0.5) == pytest.approx(0.5 * speed_with(1.0), rel=0.05)


def test_digital_and_analog_outputs_are_read_back(client):
    client.io.setStandardDigitalOut(3, True)
    client.io.setConfigurableDigitalOut(1, True)
    client.io.setToolDigitalOut(0, True)
    client.io.setAnalogOutputVoltage(1, 0.4)
    bits = 1 << 3 | 1 << 9 | 1 << 16
    wait_until(lambda: client.receive.getActualDigitalOutputBits() == bits)
    wait_until(lambda: client.receive.getStandardAnalogOutput1() == 0.4)
    client.io.setStandardDigitalOut(3, False)
    client.io.setConfigurableDigitalOut(1, False)
    client.io.setToolDigitalOut(0, False)
    wait_until(lambda: client.receive.getActualDigitalOutputBits() == 0)


def test_kinematics_calls_agree_with_ours(client):
    joints = [0.3, -1.2, 1.4, -1.1, -1.3, 0.5]
    pose = list(kinematics.pose_from_transform(kinematics.forward(joints)))
    solved = client.control.getInverseKinematics(pose, joints)
    assert solved == pytest.approx(joints, abs=1e-6)
    here = client.control.getForwardKinematics()
    assert here == pytest.approx(client.receive.getActualTCPPose(), abs=1e-9)
    assert client.control.getInverseKinematicsHasSolution(pose)
    assert not client.control.getInverseKinematicsHasSolution([1.3, 0.0, 0.0, 0.0, 0.0, 0.0])


def test_the_tool_centre_point_and_the_payload_are_taken_over(client):
    flange = np.array(client.receive.getActualTCPPose()[:3])
    assert client.control.setTcp([0.0, 0.0, 0.1, 0.0, 0.0, 0.0])
    assert client.control.getTCPOffset() == pytest.approx([0, 0, 0.1, 0, 0, 0], abs=1e-12)
    client.catch_up()
    tool = np.array(client.receive.getActualTCPPose()[:3])
    assert np.linalg.norm(tool - flange) == pytest.approx(0.1, abs=1e-9)
    pose = shifted(client, dz=-0.05)
    assert client.control.moveL(pose, 0.25, 0.5)
    client.catch_up()
    assert client.receive.getActualTCPPose()[:3] == pytest.approx(pose[:3], abs=1e-8)

    assert client.control.setPayload(1.2, [0.0, 0.01, 0.05])
    wait_until(lambda: client.receive.getPayload() == 1.2)
    assert client.receive.getPayloadCog() == [0.0, 0.01, 0.05]


def test_safety_limits_can_be_asked(client):
    assert client.control.isPoseWithinSafetyLimits(client.receive.getActualTCPPose())
    assert not client.control.isPoseWithinSafetyLimits([1.3, 0.0, 0.5, 0.0, 0.0, 0.0])
    assert client.control.isJointsWithinSafetyLimits(HOME)
    assert not client.control.isJointsWithinSafetyLimits([6.4, 0.0, 0.0, 0.0, 0.0, 0.0])


@pytest.mark.parametrize("target", [[1.3, 0.0, 0.0, 0.0, 0.0, 0.0], [6.4, *HOME[1:]]])
def test_a_target_nobody_can_reach_ends_the_program_and_moves_nothing(client, target):
    before = client.receive.getActualQ()
    move = client.control.moveJ if target[0] > 6 else client.control.moveL
    assert not move(target, 0.25, 0.5)
    wait_until(lambda: not client.control.isProgramRunning())
    assert client.receive.getActualQ() == before


def test_a_line_through_the_column_ends_in_a_protective_stop(client):
    mirrored = client.receive.getActualTCPPose()
    mirrored[:2] = -mirrored[0], -mirrored[1]
    assert client.control.isPoseWithinSafetyLimits(mirrored)
    assert not client.control.moveL(mirrored, 0.25, 0.5)
    wait_until(client.receive.isProtectiveStopped)


def test_a_protective_stop_holds_until_unlocked_and_the_script_is_new(client, fake, dashboard):
    target = shifted(client, dz=-0.3)
    assert client.control.moveL(target, 0.02, 0.5, True)
    wait_until(lambda: client.receive.getActualTCPSpeed()[2] < -0.01)
    fake.do("protective_stop")
    wait_until(client.receive.isProtectiveStopped)
    assert client.receive.getSafetyMode() == 3
    assert client.receive.getSafetyStatusBits() == 1 << 2 | 1 << 10
    assert client.receive.getRuntimeState() == 4
    with pytest.raises(RuntimeError, match="until 5s after"):
        dashboard.unlockProtectiveStop()
    time.sleep(5.1 / 20)
    dashboard.unlockProtectiveStop()
    wait_until(lambda: not client.receive.isProtectiveStopped())
    rest = client.receive.getActualTCPPose()
    assert not client.control.moveL(target, 0.25, 0.5)
    assert client.receive.getActualTCPPose() == rest

    assert client.control.reuploadScript()
    wait_until(client.control.isProgramRunning)
    assert client.control.moveL(target, 0.25, 0.5)
    client.catch_up()
    assert client.receive.getActualTCPPose()[2] == pytest.approx(target[2], abs=1e-8)


def test_a_paused_program_takes_its_move_up_again_on_play(client, dashboard):
    target = shifted(client, dz=-0.3)
    assert client.control.moveL(target, 0.05, 0.5, True)
    wait_until(lambda: client.receive.getActualTCPSpeed()[2] < -0.03)
    dashboard.pause()
    wait_until(lambda: client.receive.getActualTCPSpeed()[2] == 0.0)
    assert client.receive.getActualTCPPose()[2] > target[2] + 0.01
    dashboard.play()
    wait_until(lambda: abs(client.receive.getActualTCPPose()[2] - target[2]) < 1e-8)


def test_an_emergency_stop_takes_the_power(client, fake, dashboard):
    fake.do("emergency_stop")
    wait_until(client.receive.isEmergencyStopped)
    assert client.receive.getRobotMode() == 3
    assert client.receive.getSafetyMode() == 7
    assert not client.control.moveJ(HOME, 1.0, 1.0)
    dashboard.powerOn()
    client.catch_up()
    assert client.receive.getRobotMode() == 3

    fake.do("release_emergency_stop")
    dashboard.powerOn()
    wait_until(lambda: client.receive.getRobotMode() == 5)
    dashboard.brakeRelease()
    wait_until(lambda: client.receive.getRobotMode() == 7)
    assert client.control.reuploadScript()
    wait_until(client.control.isProgramRunning)
    assert client.control.moveJ(HOME, 3.0, 10.0)


def test_the_watchdog_ends_the_program_of_a_silent_client(client, fake):
    target = shifted(client, dz=-0.3)
    assert client.control.setWatchdog(4.0)
    assert client.control.moveL(target, 0.01, 0.5, True)
    for _ in range(20):
        client.control.kickWatchdog()
        time.sleep(0.02)
    assert client.control.isProgramRunning()
    wait_until(lambda: not client.control.isProgramRunning())
    client.catch_up()
    state = fake.do("state")
    assert not state["moving"]
    assert state["tcp_pose"][2] > target[2] + 0.01


def test_a_refused_script_does_not_run(client, fake):
    client.control.stopScript()
    fake.do("refuse_scripts")
    client.control.reuploadScript()
    time.sleep(0.1)
    assert not client.control.isProgramRunning()
    assert not client.control.moveJ(HOME, 1.0, 1.0)


def test_straight_programs_run_and_others_are_refused(client):
    control = client.control
    pose = shifted(client, dz=-0.02)
    script = f"movel(p{pose},a=0.5,v=0.25)\nsleep(0.1)"
    assert control.sendCustomScriptFunction("go", script)
    client.catch_up()
    assert client.receive.getActualTCPPose()[2] == pytest.approx(pose[2], abs=1e-8)
    wait_until(control.isProgramRunning)


def test_registers_belong_to_one_client(client):
    with pytest.raises(RuntimeError, match="already in use"):
        rtde_control.RTDEControlInterface(client.fake.host)


def test_unknown_variables_are_named(client):
    with pytest.raises(RuntimeError, match="actual_happiness"):
        rtde_receive.RTDEReceiveInterface(
            client.fake.host, 125.0, ["timestamp", "actual_happiness"]
        )
