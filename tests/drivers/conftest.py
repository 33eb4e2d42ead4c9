import time

import pytest

from drivers.ur5.arm import Ur5Arm
from drivers.ur5.messages import Ur5Config
from mock_hw.fake_ur.process import FakeUr, free_host


@pytest.fixture(scope="module")
def version():
    return "3.15"


@pytest.fixture(scope="module")
def shared_fake(version):
    pytest.importorskip("rtde_control", reason="ur-rtde has no wheel for this Python")
    with FakeUr(free_host(), version=version, time_scale=20) as running:
        yield running


@pytest.fixture
def fake(shared_fake):
    """A fake controller at home and in its normal state."""
    shared_fake.do("home")
    yield shared_fake
    shared_fake.do("reset")
    time.sleep(0.03)


@pytest.fixture
def make_arm(fake):
    return lambda: Ur5Arm(Ur5Config(host=fake.host, payload_kg=0.6, script_timeout_s=0.5))
