import time

import pytest

from mock_hw.fake_ur.process import FakeUr, free_host


@pytest.fixture(scope="module", params=["3.15", "5.15"])
def version(request):
    return request.param


@pytest.fixture(scope="module")
def shared_fake(version):
    with FakeUr(free_host(), version=version, time_scale=20) as running:
        yield running


@pytest.fixture
def fake(shared_fake):
    """A fake controller in its normal state; what a test breaks is mended after it."""
    yield shared_fake
    shared_fake.do("reset")
    time.sleep(0.03)
