"""`canopy calibrate`: from a recorded scan of a board to the line of the rig file."""

import json
import re
import tomllib

import cv2
import numpy as np
import pytest
from live_rig import RIG_PAGE, rig_file
from scenes.board import BASE_FROM_BOARD, BOARD, cameras, mounted, picture

from canopy_skel.frame import View
from canopy_skel.geometry import invert, transform_from, transform_points
from canopy_skel.recording import RecordingWriter
from drivers.hand_eye import apart
from mock_hw.orchard.path import OAK_D, TOOL_FROM_CAMERA
from service.rig_file import read_rig_file

TRUE = mounted([0.02, -0.03, 0.01], [0.004, 0.002, -0.006])


def record(path, poses, spoilt=(), moved_from=None, row_only=()):
    """A scan of the board by a rig that believes in another hand-eye transform.

    Views `spoilt` show nothing, `row_only` little more than a row of the board; from view
    `moved_from` on, the board is 20 mm aside.
    """
    rng = np.random.default_rng(7)
    with RecordingWriter(path, {"scan_id": "b"}, tool_from_camera=TOOL_FROM_CAMERA) as writer:
        for index, base_from_camera in enumerate(poses):
            moved = moved_from is not None and index >= moved_from
            aside = transform_from(np.eye(3), [0, 0.02 * moved, 0])
            seen = picture(invert(aside) @ base_from_camera, rng)
            if index in row_only:
                seen = one_row(seen, base_from_camera)
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


def found_by(canopy, path, *arguments):
    return canopy("calibrate", path, "--square", "0.03", *arguments)


def one_row(seen, base_from_camera):
    """The picture with all of the board covered but its first two rows of squares."""
    strip_m = BOARD.square_m * np.array([[-1, -1, 0], [10, -1, 0], [10, 2, 0], [-1, 2, 0]])
    strip = OAK_D.project(transform_points(invert(base_from_camera) @ BASE_FROM_BOARD, strip_m))
    bare = cv2.fillPoly(np.zeros_like(seen), [strip.astype(np.int32)], (1, 1, 1))
    return np.where(bare > 0, seen, 127).astype(np.uint8)


@pytest.fixture(scope="module")
def scan(tmp_path_factory):
    return record(tmp_path_factory.mktemp("board") / "board.mcap", cameras(16), spoilt=(2,))


def test_a_scan_of_a_board_gives_the_line_for_the_rig_file(canopy, scan, tmp_path):
    code, stdout, _ = found_by(canopy, scan)
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
    code, stdout, _ = found_by(canopy, scan, "--json")
    facts = json.loads(stdout)
    assert (code, facts["accepted"], facts["doubts"]) == (0, True, [])
    assert facts["scale"] == pytest.approx(1, abs=0.002)
    assert facts["scale_std"] < 0.001
    assert apart(np.array(facts["tool_from_camera"]), TRUE)[0] < 0.0003
    moved_m, turned_deg = apart(TOOL_FROM_CAMERA, TRUE)
    assert facts["moved_m"] == pytest.approx(moved_m, abs=0.0003)
    assert facts["turned_deg"] == pytest.approx(turned_deg, abs=0.03)
    assert [view["index"] for view in facts["views"]] == [0, 1, *range(3, 16)]
    assert all(view["corners"] > 20 and view["residual_px"] < 0.5 for view in facts["views"])
    assert facts["unseen"] == [{"index": 2, "reason": "0 corners of the board are seen"}]


def test_too_few_views_are_refused_with_the_mend(canopy, tmp_path):
    path = record(tmp_path / "board.mcap", cameras(5))
    code, _, stderr = found_by(canopy, path)
    assert code == 1
    assert "5 views show enough of the board" in stderr


def test_another_board_than_the_one_named_shows_nothing(canopy, scan):
    code, _, stderr = found_by(canopy, scan, "--dictionary", "6X6_250")
    assert code == 1
    assert "0 views show enough of the board" in stderr


def test_a_result_that_is_not_sure_enough_is_not_accepted(canopy, scan, monkeypatch):
    monkeypatch.setattr("service.calibration.MOST_STD_M", 1e-9)
    code, stdout, _ = found_by(canopy, scan)
    assert code == 1
    assert "Not accepted: more uncertain than" in stdout
    assert "tool_from_camera" not in stdout


def test_squares_of_another_size_than_said_are_not_accepted(canopy, scan):
    code, stdout, _ = canopy("calibrate", scan, "--square", "0.0297")
    assert code == 1
    assert re.search(r"squares seem to be (29.9|30.0)\d mm, not 29.70: measure across", stdout)
    assert "tool_from_camera" not in stdout


def test_views_at_one_distance_are_not_accepted(canopy, tmp_path):
    path = record(tmp_path / "board.mcap", cameras(8, distances_m=(0.5, 0.5), spread=0.3))
    code, stdout, _ = found_by(canopy, path)
    assert code == 1
    assert "vary it from 0.35 to 0.7 m" in stdout


def test_a_board_that_was_moved_halfway_is_not_accepted(canopy, tmp_path):
    code, stdout, _ = found_by(canopy, record(tmp_path / "b.mcap", cameras(8), moved_from=4))
    assert code == 1
    assert "Not accepted: the views do not fit each other: did the board move?" in stdout


def test_a_view_of_a_single_row_of_corners_is_not_used(canopy, tmp_path):
    path = record(tmp_path / "board.mcap", cameras(9), row_only=(4,))
    facts = json.loads(found_by(canopy, path, "--json")[1])
    assert [one["index"] for one in facts["unseen"]] == [4]
    assert "of the board that are seen lie along one line" in facts["unseen"][0]["reason"]


def test_a_board_can_be_drawn_to_print_it(canopy, tmp_path):
    assert canopy("calibrate", "--draw", tmp_path / "board.png")[0] == 0
    drawn = cv2.imread(str(tmp_path / "board.png"), cv2.IMREAD_GRAYSCALE)
    assert drawn.shape == (7 * 120, 10 * 120)


@pytest.mark.parametrize(
    ("arguments", "why"),
    [
        ((), "give either a recording of the board, or --draw"),
        (("a.mcap", "--draw", "b.png"), "give either a recording of the board, or --draw"),
        (("a.mcap",), "measure across the whole board as printed and divide"),
        (("a.mcap", "--marker", "0.02"), "measure across the whole board as printed and divide"),
        (("a.mcap", "--squares", "9"), "give COLUMNSxROWS"),
        (("a.mcap", "--square", "0.03", "--marker", "0.04"), "markers are smaller"),
    ],
)
def test_wrong_arguments_are_refused(arguments, why, canopy):
    code, _, stderr = canopy("calibrate", *arguments)
    assert code == 2
    assert why in stderr
