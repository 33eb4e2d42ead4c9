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


@pytest.fixture
def canopy(monkeypatch, capsys):
    """Run the command line as a user does; returns exit code, stdout, stderr."""
    from service.cli import main

    def run(*arguments):
        monkeypatch.setattr(sys, "argv", ["canopy", *map(str, arguments)])
        with pytest.raises(SystemExit) as stopped:
            main()
        captured = capsys.readouterr()
        return stopped.value.code or 0, captured.out, captured.err

    return run
