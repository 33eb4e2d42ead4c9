"""`canopy calibrate`: from a recorded scan of a board to the line of the rig file."""

import json
import re
import tomllib

import cv2
import numpy as np
import pytest
from live_rig import RIG_PAGE, rig_file
from scenes.board import cameras, mounted, picture

from canopy_skel.frame import View
from canopy_skel.geometry import invert
from canopy_skel.recording import RecordingWriter
from drivers.hand_eye import apart
from mock_hw.orchard.path import OAK_D, TOOL_FROM_CAMERA
from service.rig_file import read_rig_file

TRUE = mounted([0.02, -0.03, 0.01], [0.004, 0.002, -0.006])


def record(path, poses, spoilt=()):
    """A scan of the board by a rig that believes in another hand-eye transform."""
    rng = np.random.default_rng(7)
    with RecordingWriter(path, {"scan_id": "b"}, tool_from_camera=TOOL_FROM_CAMERA) as writer:
        for index, base_from_camera in enumerate(poses):
            seen = picture(base_from_camera, rng)
            writer.write_view(
                View(
                    index=index,
                    stamp_ns=1_700_000_000_000_000_000 + index * 10**9,
                    color_rgb=np.full_like(seen, 90) if index in spoilt else seen,
                    intrinsics=OAK_D,
                    base_from_camera=base_from_camera @ invert(TRUE) @ TOOL_FROM_CAMERA,
                    depth_m=np.full(seen.shape[:2], 0.5, np.float32),
                )
            )
    return path


@pytest.fixture(scope="module")
def scan(tmp_path_factory):
    return record(tmp_path_factory.mktemp("board") / "board.mcap", cameras(16), spoilt=(2,))


def test_a_scan_of_a_board_gives_the_line_for_the_rig_file(canopy, scan, tmp_path):
    code, stdout, _ = canopy("calibrate", scan)
    assert code == 0, stdout
    assert "2  0 corners of the board are seen" in stdout
    line = stdout.splitlines()[-1]
    assert stdout.splitlines()[-2] == "For [camera] of the rig file:"
    [old] = re.findall(r"^tool_from_camera.*$", RIG_PAGE.read_text(), re.MULTILINE)
    rig = read_rig_file(rig_file(tmp_path, (old, line)))
    away_m, turned_deg = apart(rig.camera.tool_from_camera.matrix(), TRUE)
    assert away_m < 0.0003
    assert turned_deg < 0.03
    assert tomllib.loads(line)


def test_programs_read_what_came_of_it(canopy, scan):
    code, stdout, _ = canopy("calibrate", scan, "--json")
    facts = json.loads(stdout)
    assert (code, facts["accepted"]) == (0, True)
    assert apart(np.array(facts["tool_from_camera"]), TRUE)[0] < 0.0003
    moved_m, turned_deg = apart(TOOL_FROM_CAMERA, TRUE)
    assert facts["moved_m"] == pytest.approx(moved_m, abs=0.0003)
    assert facts["turned_deg"] == pytest.approx(turned_deg, abs=0.03)
    assert [view["index"] for view in facts["views"]] == [0, 1, *range(3, 16)]
    assert all(view["corners"] > 20 and view["residual_px"] < 0.5 for view in facts["views"])
    assert facts["unseen"] == [{"index": 2, "reason": "0 corners of the board are seen"}]


def test_too_few_views_are_refused_with_the_mend(canopy, tmp_path):
    path = record(tmp_path / "board.mcap", cameras(5))
    code, _, stderr = canopy("calibrate", path)
    assert code == 1
    assert "5 views show enough of the board" in stderr


def test_another_board_than_the_one_named_shows_nothing(canopy, scan):
    code, _, stderr = canopy("calibrate", scan, "--dictionary", "6X6_250")
    assert code == 1
    assert "0 views show enough of the board" in stderr


def test_a_result_that_is_not_sure_enough_is_not_accepted(canopy, scan, monkeypatch):
    monkeypatch.setattr("service.calibration.MOST_STD_M", 1e-9)
    code, stdout, _ = canopy("calibrate", scan)
    assert code == 1
    assert "Not accepted" in stdout
    assert "tool_from_camera" not in stdout


def test_a_board_can_be_drawn_to_print_it(canopy, tmp_path):
    assert canopy("calibrate", "--draw", tmp_path / "board.png")[0] == 0
    drawn = cv2.imread(str(tmp_path / "board.png"), cv2.IMREAD_GRAYSCALE)
    assert drawn.shape == (7 * 120, 10 * 120)


@pytest.mark.parametrize(
    ("arguments", "why"),
    [
        ((), "give either a recording of the board, or --draw"),
        (("a.mcap", "--draw", "b.png"), "give either a recording of the board, or --draw"),
        (("a.mcap", "--squares", "9"), "give COLUMNSxROWS"),
        (("a.mcap", "--marker", "0.04"), "markers are smaller"),
    ],
)
def test_wrong_arguments_are_refused(arguments, why, canopy):
    code, _, stderr = canopy("calibrate", *arguments)
    assert code == 2
    assert why in stderr
