"""What the driver does when something breaks in the middle of a move."""

import os
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
from contracts.arm import assert_stands_still, down, linear

from drivers.errors import (
    ArmError,
    ArmLinkError,
    ControllerFrozenError,
    DriverProcessError,
    EmergencyStopError,
    LinkLostError,
    MoveRefusedError,
    NotAcknowledgedError,
    NotConnectedError,
    NotInRemoteControlError,
    NotPoweredError,
    ProtectiveStopError,
    SafeguardStopError,
)
from drivers.protocols import ArmMode, wait_settled
from drivers.ur5.arm import Ur5Arm
from drivers.ur5.dashboard import Dashboard
from drivers.ur5.messages import Ur5Config
from mock_hw.fake_ur.process import FakeUr, free_host

WAY_M = 0.4
UNLOCK_S = 5.2 / 20


@pytest.fixture(scope="module")
def version():
    return "5.15"


@pytest.fixture
def arm(make_arm):
    with make_arm() as arm:
        yield arm


@pytest.fixture
def moving(arm):
    """An arm at the beginning of a move that takes two seconds of host time."""
    target = down(arm.state(), WAY_M)
    arm.start_move(linear(target, speed_mps=0.01))
    time.sleep(0.1)
    assert arm.state().mode is ArmMode.MOVING
    return arm, target


def reconnected(arm, within_s=5.0):
    until = time.perf_counter() + within_s
    while True:
        try:
            return arm.state()
        except ArmLinkError:
            assert time.perf_counter() < until
            time.sleep(0.01)


def assert_held_until_acknowledged(fake, arm, target):
    """The arm stands far from its target, refuses, is released, still stands, then arrives."""
    held = reconnected(arm)
    assert held.mode not in (ArmMode.READY, ArmMode.MOVING)
    time.sleep(0.3)
    before = fake.do("state")
    assert not before["moving"]
    assert before["tcp_pose"][2] > target[2, 3] + 0.05
    with pytest.raises(ArmError):
        arm.start_move(linear(target))
    arm.acknowledge("looked at the tree, nothing touches")
    assert arm.state().mode is ArmMode.READY
    assert Dashboard(fake.host).ask("play") == "Failed to execute: play"
    assert_stands_still(arm)
    assert fake.do("state")["joints_rad"] == before["joints_rad"]
    arm.start_move(linear(target))
    end = wait_settled(arm, timeout_s=10.0)
    assert end.pose.base_from_tool0 == pytest.approx(target, abs=1e-6)


def test_protective_stop(fake, moving):
    arm, target = moving
    fake.do("protective_stop")
    with pytest.raises(ProtectiveStopError, match="look for the cause"):
        wait_settled(arm, timeout_s=2.0)
    assert arm.state().mode is ArmMode.PROTECTIVE_STOP
    with pytest.raises(ProtectiveStopError):
        arm.start_move(linear(target))
    time.sleep(UNLOCK_S)
    assert_held_until_acknowledged(fake, arm, target)


def test_a_protective_stop_is_not_unlocked_too_early(make_arm):
    with FakeUr(free_host(), time_scale=1) as fake, Ur5Arm(Ur5Config(host=fake.host)) as arm:
        fake.do("protective_stop")
        with pytest.raises(ProtectiveStopError):
            wait_settled(arm, timeout_s=2.0)
        with pytest.raises(ProtectiveStopError, match="until 5s after occurrence"):
            arm.acknowledge("too quick")
        assert arm.state().mode is ArmMode.PROTECTIVE_STOP


def test_a_stop_mended_at_the_pendant_still_needs_an_acknowledgement(fake, moving):
    arm, target = moving
    fake.do("protective_stop")
    with pytest.raises(ProtectiveStopError):
        wait_settled(arm, timeout_s=2.0)
    time.sleep(UNLOCK_S)
    fake.do("unlock")
    assert Dashboard(fake.host).ask("play") == "Failed to execute: play"
    time.sleep(0.05)
    with pytest.raises(NotAcknowledgedError, match="protective stop"):
        arm.start_move(linear(target))
    assert_held_until_acknowledged(fake, arm, target)


@pytest.fixture
def moving_without_watchdog(fake):
    """As `moving`, but the controller's watchdog is too slow to be of help."""
    with Ur5Arm(Ur5Config(host=fake.host, watchdog_hz=0.05)) as arm:
        target = down(arm.state(), WAY_M)
        arm.start_move(linear(target, speed_mps=0.01))
        yield arm, target


def test_a_stopped_move_is_dropped_at_once_on_the_controller(fake, moving_without_watchdog):
    arm, target = moving_without_watchdog
    fake.do("protective_stop")
    with pytest.raises(ProtectiveStopError):
        wait_settled(arm, timeout_s=2.0)
    time.sleep(UNLOCK_S)
    fake.do("unlock")
    assert Dashboard(fake.host).ask("play") == "Failed to execute: play"
    assert_held_until_acknowledged(fake, arm, target)


def test_the_death_of_the_driver_process_stops_the_arm_over_the_dashboard(
    fake, moving_without_watchdog
):
    arm, target = moving_without_watchdog
    os.kill(arm._link.pid, signal.SIGKILL)
    with pytest.raises(DriverProcessError):
        wait_settled(arm, timeout_s=2.0)
    assert_held_until_acknowledged(fake, arm, target)


def test_emergency_stop(fake, moving):
    arm, target = moving
    fake.do("emergency_stop")
    with pytest.raises(EmergencyStopError, match="release the button"):
        wait_settled(arm, timeout_s=2.0)
    with pytest.raises(EmergencyStopError):
        arm.acknowledge("the button is still pressed")
    fake.do("release_emergency_stop")
    time.sleep(0.05)
    assert arm.state().mode is ArmMode.NOT_POWERED
    assert_held_until_acknowledged(fake, arm, target)


def test_safeguard_stop(fake, moving):
    arm, target = moving
    fake.do("safeguard_stop")
    with pytest.raises(SafeguardStopError, match="close the safeguard"):
        wait_settled(arm, timeout_s=2.0)
    with pytest.raises(SafeguardStopError):
        arm.acknowledge("the door is still open")
    fake.do("close_safeguard")
    time.sleep(0.05)
    assert arm.state().mode is ArmMode.NOT_ACKNOWLEDGED
    assert_held_until_acknowledged(fake, arm, target)


def test_power_off(fake, moving):
    arm, target = moving
    fake.do("power_off")
    with pytest.raises(NotPoweredError):
        wait_settled(arm, timeout_s=2.0)
    assert_held_until_acknowledged(fake, arm, target)


@pytest.mark.parametrize("line", ["stop", "pause"])
def test_somebody_ends_or_pauses_the_program_at_the_pendant(fake, moving, line):
    arm, target = moving
    Dashboard(fake.host).ask(line)
    with pytest.raises(NotAcknowledgedError, match="ended or paused"):
        wait_settled(arm, timeout_s=2.0)
    assert_held_until_acknowledged(fake, arm, target)


@pytest.mark.parametrize("line", ["stop", "pause", "power off"])
def test_what_somebody_ends_at_the_pendant_while_the_arm_stands_is_not_begun_anew(fake, arm, line):
    target = down(arm.state(), WAY_M)
    arm.start_move(linear(down(arm.state(), 0.01)))
    wait_settled(arm, timeout_s=10.0)
    Dashboard(fake.host).ask(line)
    time.sleep(0.1)
    if line == "power off":
        for mend in ("power on", "brake release"):
            Dashboard(fake.host).ask(mend)
    time.sleep(0.1)
    with pytest.raises(ArmError):
        arm.start_move(linear(target))
    assert_stands_still(arm)
    arm.acknowledge("looked at the tree, nobody near")
    arm.start_move(linear(target))
    end = wait_settled(arm, timeout_s=10.0)
    assert end.pose.base_from_tool0 == pytest.approx(target, abs=1e-6)


def test_a_move_stopped_after_a_safety_stop_is_dropped_on_the_controller(
    fake, moving_without_watchdog
):
    arm, _ = moving_without_watchdog
    time.sleep(0.1)
    fake.do("protective_stop")
    with pytest.raises(ProtectiveStopError):
        wait_settled(arm, timeout_s=2.0)
    arm.stop()
    time.sleep(UNLOCK_S)
    fake.do("unlock")
    assert Dashboard(fake.host).ask("play") == "Failed to execute: play"
    assert_stands_still(arm)


def test_link_drop(fake, moving):
    arm, target = moving
    fake.do("cut_link")
    with pytest.raises(LinkLostError):
        wait_settled(arm, timeout_s=2.0)
    time.sleep(0.5)
    assert not fake.do("state")["moving"], "the watchdog must have stopped it"
    with pytest.raises(ArmLinkError):
        arm.state()
    fake.do("mend_link")
    assert_held_until_acknowledged(fake, arm, target)


def test_frozen_controller(fake, moving):
    arm, target = moving
    fake.do("freeze")
    frozen_at = time.perf_counter()
    with pytest.raises(ControllerFrozenError, match="has sent nothing"):
        wait_settled(arm, timeout_s=2.0)
    assert time.perf_counter() - frozen_at < 1.0
    with pytest.raises(NotConnectedError, match="use the emergency stop"):
        arm.stop()
    assert not fake.do("state")["moving"], "the watchdog must have stopped it"
    fake.do("mend_link")
    assert_held_until_acknowledged(fake, arm, target)


def test_slow_packets_delay_the_state_but_are_no_fault(fake, arm):
    fake.do("slow_packets", period_s=0.1)
    target = down(arm.state(), 0.05)
    arm.start_move(linear(target))
    end = wait_settled(arm, timeout_s=5.0)
    assert end.pose.base_from_tool0 == pytest.approx(target, abs=1e-6)


def test_controller_killed_and_started_again():
    host = free_host()
    with FakeUr(host, time_scale=20) as fake, Ur5Arm(Ur5Config(host=host)) as arm:
        target = down(arm.state(), WAY_M)
        arm.start_move(linear(target, speed_mps=0.01))
        fake.kill()
        with pytest.raises(ArmLinkError):
            wait_settled(arm, timeout_s=2.0)
        with pytest.raises(ArmLinkError):
            arm.stop()
        with FakeUr(host, time_scale=20) as fresh:
            assert_held_until_acknowledged(fresh, arm, target)


def test_driver_process_killed(fake, moving):
    arm, target = moving
    os.kill(arm._link.pid, signal.SIGKILL)
    with pytest.raises(DriverProcessError, match=r"died \(exit code -9\)"):
        wait_settled(arm, timeout_s=2.0)
    assert_held_until_acknowledged(fake, arm, target)


@pytest.mark.parametrize("stop", [Ur5Arm.stop, Ur5Arm.drop])
def test_stop_works_while_the_driver_process_hangs(fake, moving, stop):
    arm, target = moving
    os.kill(arm._link.pid, signal.SIGSTOP)
    began = time.perf_counter()
    stop(arm)
    assert time.perf_counter() - began < 1.0
    time.sleep(0.05)
    assert not fake.do("state")["moving"]
    assert_held_until_acknowledged(fake, arm, target)


def test_a_hanging_driver_process_is_replaced_without_being_asked(fake, moving):
    arm, target = moving
    os.kill(arm._link.pid, signal.SIGSTOP)
    with pytest.raises(ArmLinkError):
        wait_settled(arm, timeout_s=5.0)
    time.sleep(0.3)
    assert not fake.do("state")["moving"], "the watchdog must have stopped it"
    time.sleep(1.0)
    assert_held_until_acknowledged(fake, arm, target)


def test_a_driver_process_that_dies_while_nothing_moves_is_replaced_silently(fake, arm):
    os.kill(arm._link.pid, signal.SIGKILL)
    time.sleep(0.05)
    state = reconnected(arm)
    assert state.mode is ArmMode.READY
    target = down(state, 0.05)
    arm.start_move(linear(target))
    assert np.allclose(wait_settled(arm, timeout_s=5.0).pose.base_from_tool0, target, atol=1e-6)


def test_no_move_without_power(fake, arm):
    fake.do("power_off")
    time.sleep(0.05)
    with pytest.raises(NotPoweredError, match="acknowledge to power it"):
        arm.start_move(linear(down(arm.state(), 0.05)))
    arm.acknowledge("workspace is clear")
    arm.start_move(linear(down(arm.state(), 0.05)))
    wait_settled(arm, timeout_s=5.0)


def test_no_move_in_local_control(fake, arm):
    fake.do("local_control")
    with pytest.raises(NotInRemoteControlError, match="switch the controller to remote control"):
        arm.start_move(linear(down(arm.state(), 0.05)))
    fake.do("reset")
    arm.start_move(linear(down(arm.state(), 0.05)))
    wait_settled(arm, timeout_s=5.0)


def test_a_refused_script_is_a_refused_move(fake, arm):
    fake.do("refuse_scripts")
    with pytest.raises(MoveRefusedError, match="control script"):
        arm.start_move(linear(down(arm.state(), 0.05)))
    assert_stands_still(arm)
    fake.do("reset")
    arm.start_move(linear(down(arm.state(), 0.05)))
    wait_settled(arm, timeout_s=5.0)


_HOLDER = """
import sys, time
from contracts.arm import down, linear
from drivers.ur5.arm import Ur5Arm
from drivers.ur5.messages import Ur5Config

with Ur5Arm(Ur5Config(host=sys.argv[1])) as arm:
    arm.start_move(linear(down(arm.state(), 0.4), speed_mps=0.01))
    print(arm._link.pid, flush=True)
    time.sleep(60)
"""


def test_the_arm_stops_when_the_whole_program_is_killed(fake):
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    with subprocess.Popen(
        [sys.executable, "-c", _HOLDER, fake.host], stdout=subprocess.PIPE, env=environment
    ) as program:
        child = int(program.stdout.readline())
        assert fake.do("state")["runtime_state"] == "PLAYING"
        program.kill()
    until = time.perf_counter() + 2.0
    while fake.do("state")["moving"] or os.path.exists(f"/proc/{child}"):
        assert time.perf_counter() < until
        time.sleep(0.02)
    assert fake.do("state")["runtime_state"] == "STOPPED"
