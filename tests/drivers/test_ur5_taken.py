"""One controller and two who want it: the second is refused, and the first notices nothing."""

import os
import signal
import socket
import time
from concurrent.futures import ThreadPoolExecutor
from types import SimpleNamespace

import pytest
from contracts.arm import down, linear

from drivers.errors import ArmLinkError, ArmTakenError, DriverProcessError, NotConnectedError
from drivers.protocols import ArmMode, wait_settled
from drivers.ur5.arm import Ur5Arm
from drivers.ur5.dashboard import Dashboard
from drivers.ur5.messages import Prepare, RuntimeState, Ur5Config
from drivers.ur5.mover import Mover
from drivers.ur5.watch import MoveRecord

NO_WHEEL = "ur-rtde has no wheel for this Python"
rtde_control = pytest.importorskip("rtde_control", reason=NO_WHEEL)
Vendor = rtde_control.RTDEControlInterface

LOWER_HALF = Vendor.FLAG_UPLOAD_SCRIPT
UPPER_HALF = LOWER_HALF | Vendor.FLAG_UPPER_RANGE_REGISTERS | Vendor.FLAG_NO_EXT_FT
HALVES = pytest.mark.parametrize("flags", [LOWER_HALF, UPPER_HALF], ids=["lower", "upper"])
WAY_M = 0.3


@pytest.fixture
def make_arm(fake):
    # More patient than the rig's: a busy machine is silent for a moment, too.
    patient = Ur5Config(host=fake.host, watchdog_hz=1.0, stale_after_s=0.8, return_timeout_s=0.2)
    return lambda: Ur5Arm(patient)


@pytest.fixture
def arm(make_arm):
    with make_arm() as arm:
        yield arm


def slowly(arm):
    """Begin a move of a second and a half of host time; return where it leads."""
    target = down(arm.state(), WAY_M)
    arm.start_move(linear(target, speed_mps=0.01))
    return target


def assert_arrives(arm, target):
    end = wait_settled(arm, timeout_s=10.0)
    assert end.pose.base_from_tool0 == pytest.approx(target, abs=1e-6)


def wait_until(condition, timeout_s=5.0):
    until = time.perf_counter() + timeout_s
    while not condition():
        assert time.perf_counter() < until
        time.sleep(0.01)


def height_of(fake):
    return fake.do("state")["tcp_pose"][2]


class VendorMove:
    """The unmodified client in the middle of a move of its own, which takes two seconds."""

    def __init__(self, fake, flags):
        self._fake = fake
        self._control = Vendor(fake.host, 125.0, flags)
        pose = fake.do("state")["tcp_pose"]
        self._height_m = pose[2] - WAY_M
        assert self._control.moveL([*pose[:2], self._height_m, *pose[3:]], 0.008, 0.5, True)
        wait_until(lambda: fake.do("state")["moving"])

    def assert_arrives(self):
        wait_until(lambda: abs(height_of(self._fake) - self._height_m) < 1e-6)
        assert self._control.isProgramRunning()

    def leave(self):
        self._control.stopScript()
        self._control.disconnect()


def upload_move(fake):
    """Have the controller run a program that nobody looks after; return the height it leads to."""
    x, y, z, *turn = fake.do("state")["tcp_pose"]
    target = [x, y, z - WAY_M, *turn]
    with socket.create_connection((fake.host, 30002)) as link:
        link.sendall(f"def errand():\n  movel(p{target}, a=0.5, v=0.01)\nend\n".encode())
        wait_until(lambda: fake.do("state")["runtime_state"] == "PLAYING")
    time.sleep(0.1)
    return target[2]


def test_a_second_driver_is_refused_and_the_first_moves_on(fake, arm, make_arm):
    target = slowly(arm)
    second = make_arm()
    mend = rf"controller at {fake.host} is taken: .*a second service.* end that one"
    for _ in range(3):
        with pytest.raises(ArmTakenError, match=mend), second:
            pass
        assert arm.state().mode is ArmMode.MOVING
    assert_arrives(arm, target)

    arm.__exit__(None, None, None)
    with second:
        assert_arrives(second, slowly(second))


@HALVES
def test_the_vendors_client_is_refused_and_the_arm_moves_on(fake, arm, flags):
    target = slowly(arm)
    with pytest.raises(RuntimeError, match="already in use"):
        Vendor(fake.host, 125.0, flags)
    assert arm.state().mode is ArmMode.MOVING
    assert_arrives(arm, target)


@HALVES
def test_the_vendors_client_keeps_the_arm_until_it_leaves(fake, make_arm, flags):
    vendor = VendorMove(fake, flags)
    arm = make_arm()
    with pytest.raises(ArmTakenError), arm:
        pass
    vendor.assert_arrives()
    vendor.leave()
    with arm:
        assert_arrives(arm, slowly(arm))


@HALVES
def test_who_loses_the_arm_to_another_leaves_it_alone(fake, make_arm, flags):
    with make_arm() as arm:
        target = slowly(arm)
        vendor = overtake(fake, arm, flags)
        wait_until(lambda: isinstance(trouble(arm), ArmTakenError))
        for asked in (
            arm.check,
            lambda: arm.start_move(linear(target)),
            lambda: arm.acknowledge("looked at the tree"),
        ):
            with pytest.raises(ArmTakenError, match="end that one"):
                asked()
        vendor.assert_arrives()
        vendor.leave()

        reconnected(arm)
        assert arm.state().mode is ArmMode.NOT_ACKNOWLEDGED
        arm.acknowledge("the other one has left")
        arm.start_move(linear(target))
        assert_arrives(arm, target)


def overtake(fake, arm, flags):
    """Let the driver process die, and another client be there before the next one is."""
    for _ in range(5):
        os.kill(arm._link.pid, signal.SIGKILL)
        wait_until(lambda: fake.do("state")["runtime_state"] == "STOPPED")
        try:
            return VendorMove(fake, flags)
        except RuntimeError:
            reconnected(arm)
    raise AssertionError("the driver is always there first")


def reconnected(arm):
    wait_until(lambda: trouble(arm) is None)


def trouble(arm):
    try:
        arm.state()
    except ArmLinkError as error:
        return error
    return None


def test_whoever_asks_for_a_stop_gets_it(fake, arm, make_arm):
    slowly(arm)
    second = make_arm()
    with pytest.raises(ArmTakenError), second:
        pass
    second.stop()
    wait_until(lambda: not fake.do("state")["moving"])
    with pytest.raises(ArmLinkError), second:
        pass
    wait_until(lambda: arm.state().mode is ArmMode.NOT_ACKNOWLEDGED, timeout_s=10.0)


@pytest.mark.parametrize("paused", [False, True], ids=["runs", "is paused"])
def test_a_stop_ends_a_program_that_is_not_ours(fake, arm, paused):
    target = down(arm.state(), 0.05)
    upload_move(fake)
    if paused:
        Dashboard(fake.host).ask("pause")
    arm.stop()
    wait_until(lambda: fake.do("state")["runtime_state"] == "STOPPED", timeout_s=0.2)
    wait_until(lambda: not fake.do("state")["moving"])
    arm.start_move(linear(target))
    assert_arrives(arm, target)


def test_what_nobody_asked_for_leaves_a_program_that_is_not_ours_alone(fake, make_arm):
    with make_arm() as arm:
        height_m = upload_move(fake)
        arm.drop()
    wait_until(lambda: abs(height_of(fake) - height_m) < 1e-6)


def test_a_stop_that_reaches_nobody_is_said():
    with pytest.raises(NotConnectedError, match="use the emergency stop"):
        Ur5Arm(Ur5Config(host="127.0.0.1")).stop()


def test_a_program_that_nobody_looks_after_is_not_replaced(fake, arm):
    target = down(arm.state(), 0.05)
    height_m = upload_move(fake)
    mend = rf"{fake.host} is taken: .* wait for its end, or `stop` it, or end it at the pendant"
    for asked in (arm.check, lambda: arm.start_move(linear(target))):
        with pytest.raises(ArmTakenError, match=mend):
            asked()
    wait_until(lambda: abs(height_of(fake) - height_m) < 1e-6)
    wait_until(lambda: fake.do("state")["runtime_state"] == "STOPPED")
    arm.check()
    arm.start_move(linear(target))
    assert_arrives(arm, target)


def test_a_paused_program_is_not_replaced(fake, arm):
    upload_move(fake)
    Dashboard(fake.host).ask("pause")
    time.sleep(0.1)
    with pytest.raises(ArmTakenError, match="paused"):
        arm.start_move(linear(down(arm.state(), 0.05)))
    assert fake.do("state")["runtime_state"] == "PAUSED"


def test_an_acknowledgement_does_not_end_the_program_of_another(fake, arm):
    slowly(arm)
    Dashboard(fake.host).ask("stop")
    wait_until(lambda: arm.state().mode is ArmMode.NOT_ACKNOWLEDGED, timeout_s=10.0)
    height_m = upload_move(fake)
    with pytest.raises(ArmTakenError):
        arm.acknowledge("looked at the wrong arm")
    wait_until(lambda: abs(height_of(fake) - height_m) < 1e-6)
    arm.acknowledge("the errand is done")
    assert arm.state().mode is ArmMode.READY


def test_an_acknowledgement_does_not_end_the_paused_program_of_another(fake, arm):
    slowly(arm)
    Dashboard(fake.host).ask("stop")
    wait_until(lambda: arm.state().mode is ArmMode.NOT_ACKNOWLEDGED, timeout_s=10.0)
    upload_move(fake)
    Dashboard(fake.host).ask("pause")
    time.sleep(0.1)
    with pytest.raises(ArmTakenError, match="paused"):
        arm.acknowledge("looked at the wrong arm")
    assert fake.do("state")["runtime_state"] == "PAUSED"
    arm.stop()
    arm.acknowledge("the errand is called off")
    assert arm.state().mode is ArmMode.READY


def test_a_program_that_follows_ours_at_once_is_not_ended_in_its_place(fake, arm):
    slowly(arm)
    time.sleep(0.1)
    Dashboard(fake.host).ask("stop")
    wait_until_seen(arm, RuntimeState.STOPPED)
    height_m = upload_move(fake)
    wait_until(lambda: arm.state().mode is ArmMode.NOT_ACKNOWLEDGED)
    wait_until(lambda: abs(height_of(fake) - height_m) < 1e-6)


def wait_until_seen(arm, runtime_state):
    """Return within a millisecond: the driver waits 20 for the cause of an end."""
    until = time.perf_counter() + 5.0
    while arm._newest[0].runtime_state != runtime_state:
        assert time.perf_counter() < until
        time.sleep(0.0005)


def kill_while_it_sets_up(fake, arm):
    """Kill the driver process when its script plays, but the watchdog is hardly set yet."""
    target = down(arm.state(), 0.05)
    with ThreadPoolExecutor(1) as pool:
        preparing = pool.submit(arm.start_move, linear(target))
        wait_until_playing(fake)
        os.kill(arm._link.pid, signal.SIGKILL)
        with pytest.raises(DriverProcessError):
            preparing.result()
    return target


def wait_until_playing(fake):
    until = time.perf_counter() + 5.0
    while not runs(fake):
        assert time.perf_counter() < until


@pytest.fixture
def unwatched(fake):
    """An arm whose watchdog ends nothing while a test runs, even where it was set."""
    with Ur5Arm(Ur5Config(host=fake.host, watchdog_hz=0.02, stale_after_s=0.8)) as arm:
        yield arm


def test_a_script_whose_driver_process_dies_setting_it_up_is_ended(fake, unwatched):
    target = kill_while_it_sets_up(fake, unwatched)
    wait_until(lambda: fake.do("state")["runtime_state"] == "STOPPED")
    reconnected(unwatched)
    unwatched.start_move(linear(target))
    assert_arrives(unwatched, target)


def test_a_script_that_nobody_feeds_or_ends_can_be_stopped(fake, unwatched, monkeypatch):
    monkeypatch.setattr(unwatched, "_end_program", lambda: None)
    monkeypatch.setattr(unwatched, "_unfed_s", lambda: 0.1)
    target = kill_while_it_sets_up(fake, unwatched)
    reconnected(unwatched)
    with pytest.raises(ArmTakenError, match="or `stop` it"):
        unwatched.start_move(linear(target))
    unwatched.stop()
    unwatched.start_move(linear(target))
    assert_arrives(unwatched, target)


def half_set_up(fake, failing):
    """A control interface whose script plays but is not set up to the end."""

    def upload():
        upload_move(fake)
        if failing == "reuploadScript":
            raise RuntimeError("timed out")

    return SimpleNamespace(
        reuploadScript=upload,
        isProgramRunning=lambda: failing != "isProgramRunning" and runs(fake),
        setTcp=lambda pose: failing != "setTcp",
        setPayload=lambda mass_kg, cog_m: failing != "setPayload",
        setWatchdog=lambda minimum_hz: failing != "setWatchdog",
    )


def runs(fake):
    return fake.do("state")["runtime_state"] == "PLAYING"


@pytest.mark.parametrize(
    "failing", ["reuploadScript", "isProgramRunning", "setTcp", "setPayload", "setWatchdog"]
)
def test_a_script_that_is_not_set_up_to_the_end_is_ended(fake, failing):
    config = Ur5Config(host=fake.host, script_timeout_s=0.05)
    mover = Mover(half_set_up(fake, failing), config, watch=None, record=MoveRecord())
    assert "the control script" in mover.do(1, Prepare())
    assert fake.do("state")["runtime_state"] == "STOPPED"
