import sys
from pathlib import Path

import pytest

# `service` is the package under test, so what tests share is imported from here by plain name.
sys.path.insert(0, str(Path(__file__).parent))


@pytest.fixture
def live(tmp_path):
    from live_service import serving

    with serving(tmp_path) as live:
        yield live


@pytest.fixture(scope="module")
def idle(tmp_path_factory):
    """One service for all tests of a file that start no scan."""
    from live_service import serving

    with serving(tmp_path_factory.mktemp("idle")) as live:
        yield live
