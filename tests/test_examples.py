"""Each example as a user runs it: in a process of its own."""

import os
import re
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest

from canopy_skel.document import from_json
from canopy_skel.pipeline import MethodConfig
from service.replay import ReplayRequest, replay

ROOT = Path(__file__).parents[1]
needs_rtde = pytest.mark.skipif(
    find_spec("rtde_control") is None, reason="ur-rtde has no wheel for this Python"
)


@pytest.fixture
def run(tmp_path):
    def run(number):
        (example,) = (ROOT / "examples").glob(f"{number}_*.py")
        result = subprocess.run(
            [sys.executable, example],
            cwd=tmp_path,
            env=os.environ | {"PYTHONPATH": str(ROOT)},
            capture_output=True,
            text=True,
            timeout=200,
        )
        assert result.returncode == 0, result.stderr
        return result.stdout.splitlines()

    return run


def test_a_recording_gives_the_bytes_of_canopy_replay(run, tmp_path):
    lines = run("01")
    replayed = tmp_path / "replayed"
    replayed.mkdir()
    request = ReplayRequest(
        config=MethodConfig(),
        segmenter="recorded",
        formats=("json", "glb"),
        topics=None,
        memory_limit_bytes=1 << 30,
    )
    replay(ROOT / "recordings/demo_apple.mcap", replayed, request, lambda *_: None)
    written = [tmp_path / line for line in lines[-2:]]
    assert [file.suffix for file in written] == [".json", ".glb"]
    for file in written:
        assert file.read_bytes() == (replayed / file.name).read_bytes()
    assert f"{len(from_json(written[0].read_bytes()).branches)} branches; the longest:" in lines


def test_own_views_show_the_pole_and_predict_what_the_leaves_hide(run):
    rows = [
        re.fullmatch(r"\((.+), (.+), (.+)\) m: (\w+), radius (\d+) mm, confidence (.+)", line)
        for line in run("02")
    ]
    assert all(rows)
    for row in rows:
        x_m, y_m, z_m = (float(row[n]) for n in (1, 2, 3))
        assert (x_m, y_m) == pytest.approx((1.0, 0.0), abs=0.003)
        assert row[4] == ("predicted" if abs(z_m) < 0.08 else "observed")
        assert 13 <= int(row[5]) <= 17
        assert 0.5 < float(row[6]) <= 1.0


@needs_rtde
def test_a_planner_hears_of_new_revisions_and_ignores_what_is_not_sure(run):
    *answers, end = run("03")
    assert end == "the scan is done"
    assert len(answers) > 2
    revisions = []
    for answer in answers:
        row = re.match(r"after view (\d+): wood (?:seen|predicted) .* confidence (.{4})", answer)
        revisions.append(int(row[1]))
        if float(row[2]) != 0.9:  # may have been rounded to it
            assert answer.endswith("ignored") == (float(row[2]) < 0.9)
    assert revisions == sorted(revisions)


def test_a_grown_tree_is_scored_by_two_methods_on_the_same_views(run):
    first, *rows = run("04")
    assert first.endswith("10 views")
    assert [row.split()[0] for row in rows] == ["canopy", "paper"]
    precision, recall = ([float(row.split()[n]) for row in rows] for n in (2, 4))
    assert min(precision) > 0.9
    assert recall[0] > recall[1] > 0.2


@needs_rtde
def test_the_fake_arm_moves_refuses_stops_and_goes_on(run):
    moved, refused, stopped, on = run("05")[1:]
    assert moved.startswith("moved: z = ")
    assert "outside the workspace box" in refused
    assert stopped.startswith("stopped on the way: protective stop")
    assert on.startswith("and on: z = ")


def test_none_is_left_out():
    numbers = [file.name[:2] for file in sorted((ROOT / "examples").glob("*.py"))]
    assert numbers == ["01", "02", "03", "04", "05"]
