import json
import subprocess
import sys
import tomllib
from dataclasses import replace
from hashlib import sha256
from pathlib import Path

import cv2
import numpy as np
import pytest
from scenes.leaves import leafy_view
from scenes.wood import WOOD, view_from

from canopy_skel.confidence import models_from
from canopy_skel.document import Method, build_document, from_json, to_json
from canopy_skel.errors import UsageError
from canopy_skel.graph import SkeletonGraph
from canopy_skel.pipeline import MethodConfig
from canopy_skel.recording import RecordingWriter
from canopy_skel.woodpixels import pixel_model_from, pixel_model_to, shipped_pixel_model
from service.lessons import fitted, lessons_from, pixel_models_without
from service.replay import ReplayRequest, replay

ROOT = Path(__file__).parents[2]


@pytest.fixture
def recording(tmp_path):
    path = tmp_path / "sticks.mcap"
    write(path, [view_from(0), view_from(1, y=0.1), view_from(2, z=0.1)])
    return path


def write(path, views, truth=None):
    metadata = {"scan_id": "sticks-1"}
    with RecordingWriter(path, metadata, tool_from_camera=np.eye(4)) as writer:
        for view in views:
            writer.write_view(view)
        if truth is not None:
            writer.attach("ground_truth_skeleton.json", "application/json", truth)


def test_fit_confidence_writes_models_that_know_where_they_come_from(canopy, tmp_path):
    path, models = tmp_path / "leafy.mcap", tmp_path / "models.json"
    write(path, [leafy_view(0), leafy_view(1, y=0.1)])
    masks = ("--segmenter", "false50")
    code, _, stderr = canopy("fit-confidence", path, "-o", models, *masks)
    assert (code, "no true skeleton is attached" in stderr) == (1, True)
    truth = build_document(
        sticks(), scan_id="t", revision=1, method=Method(name="truth"), views_used=0
    )
    path.unlink()
    write(path, [leafy_view(0), leafy_view(1, y=0.1)], to_json(truth))
    code, stdout, _ = canopy("fit-confidence", path, "-o", models, "--held-out", path, *masks)
    assert code == 0
    rows = [line.split(" 0.")[0] for line in stdout.splitlines()]
    assert rows == ["leafy, recorded: instance_point", "leafy, false50: instance_point"]
    settings = MethodConfig(name="canopy").sha256()[:12]
    for kind, seen in (("recorded", "recorded"), ("learned", "recorded, false50")):
        for one in models_from(json.loads(models.read_bytes()))[kind].values():
            assert one.provenance == (
                f"fitted to 1 scans (masks {seen}; settings {settings}): leafy"
            )


def test_confidences_are_learned_beside_wood_pixels_of_other_trees(tmp_path):
    truth = to_json(
        build_document(sticks(), scan_id="t", revision=1, method=Method(name="truth"), views_used=0)
    )
    names = ("apple_100_fd1", "apple_100_fd2", "oak_100_fd1", "pear_1_fd1")
    *seen, unseen = [tmp_path / f"{name}.mcap" for name in names]
    for path in (*seen, unseen):
        write(path, [leafy_view(0), leafy_view(1, y=0.1)], truth)
    assert {"apple_100_fd1", "oak_100_fd1"} < shipped_pixel_model().fitted_to
    beside = pixel_models_without([*seen, unseen])
    assert [beside[path].fitted_to for path in seen] == [
        {"oak_100_fd1"},
        {"oak_100_fd1"},
        {"apple_100_fd1", "apple_100_fd2"},
    ]
    assert beside[unseen] is None
    assert pixel_models_without([unseen]) == {unseen: None}
    more = pixel_models_without(seen[2:], seen[:2])
    assert [model.fitted_to for model in more.values()] == [{"apple_100_fd1", "apple_100_fd2"}]
    with pytest.raises(UsageError, match="apple_100, the only tree"):
        pixel_models_without(seen[:2])


def test_each_kind_of_depth_has_confidences_from_its_own_scans(tmp_path):
    truth = to_json(
        build_document(sticks(), scan_id="t", revision=1, method=Method(name="truth"), views_used=0)
    )
    path = tmp_path / "leafy.mcap"
    write(path, [leafy_view(0), leafy_view(1, y=0.1)], truth)
    measured = lessons_from(path, ["recorded"])
    assert {lesson.depth for lesson in measured} == {"camera"}
    matched = [replace(lesson, depth="stereo") for lesson in measured]
    models = fitted([measured, matched], ["one", "two"], ["recorded"])
    for by_depth in models.values():
        assert by_depth["camera"].provenance.endswith(": one")
        assert by_depth["stereo"].provenance.endswith(": two")
    alone = fitted([measured], ["one"], ["recorded"])["recorded"]
    assert alone["stereo"] == alone["camera"]


def test_fit_wood_writes_a_model_that_knows_where_it_comes_from(canopy, tmp_path):
    path, output = tmp_path / "leafy.mcap", tmp_path / "wood.json"
    write(path, [leafy_view(0), leafy_view(1, y=0.1)])
    code, _, stderr = canopy("fit-wood", path, "-o", output)
    assert (code, "no true skeleton is attached" in stderr) == (1, True)
    truth = build_document(
        sticks(), scan_id="t", revision=1, method=Method(name="truth"), views_used=0
    )
    path.unlink()
    write(path, [leafy_view(0), leafy_view(1, y=0.1)], to_json(truth))
    assert canopy("fit-wood", path, "-o", output)[0] == 0
    model = pixel_model_from(json.loads(output.read_bytes()))
    assert model.provenance == "fitted to 1 scans (masks recorded): leafy"
    assert pixel_model_to(model) == output.read_bytes()


def sticks():
    points = np.array([point for start, end, _ in WOOD for point in (start, end)])
    return SkeletonGraph(
        vertices_in_base=points,
        edges=np.arange(6).reshape(3, 2),
        radius_m=np.full(6, 0.01),
        occluded=np.zeros(6, dtype=bool),
        confidence=np.ones(6),
    )


def test_replay_writes_skeleton_picture_and_summary(canopy, recording, tmp_path):
    out = tmp_path / "out"
    formats = "json,glb,swc,ply,csv,graphml"
    code, stdout, _ = canopy(
        "replay", recording, "-o", out, "--formats", formats, "--method", "paper"
    )
    assert code == 0
    names = [f"sticks.skeleton.{name}" for name in formats.split(",")]
    names += ["sticks.overlay.png", "sticks.summary.json"]
    assert sorted(path.name for path in out.iterdir()) == sorted(names)
    assert all(str(out / name) in stdout for name in names)
    document = from_json((out / "sticks.skeleton.json").read_bytes())
    assert (document.scan_id, document.views_used, document.method.name) == ("sticks-1", 3, "paper")
    assert 0.8 < sum(branch.length for branch in document.branches) < 1.3
    assert cv2.imread(str(out / "sticks.overlay.png")).shape == (240, 320, 3)
    summary = json.loads((out / "sticks.summary.json").read_text())
    assert summary["instances"] == {"found": 9, "rejected": {}}
    assert summary["joins"]["observed_components"] == 1 + len(summary["joins"]["paths"])
    assert summary["map"]["occupied_voxels"] > 1000
    assert set(summary["seconds"]) >= {"read", "cluster", "spline", "likelihood", "initial", "join"}


@pytest.mark.parametrize("method", ["canopy", "paper"])
def test_wood_farther_than_asked_for_is_left_out(canopy, recording, tmp_path, method):
    code, _, stderr = canopy(
        "replay", recording, "-o", tmp_path, "--method", method, "--farthest", "0.5"
    )
    assert (code, "no branch was found in 9 instances" in stderr) == (3, True)


@pytest.mark.parametrize("metres", ["inf", "nan", "0.3", "20.1", "-inf"])
@pytest.mark.parametrize("verb", [["replay", "some.mcap"], ["scan", "--url", "http://127.0.0.1:1"]])
def test_a_farthest_that_is_none_is_refused(canopy, tmp_path, verb, metres):
    code, _, stderr = canopy(*verb, "-o", tmp_path, "--farthest", metres)
    assert code == 2
    assert "--farthest" in stderr
    assert "range" in stderr


@pytest.mark.parametrize("metres", ["inf", "nan", "0"])
def test_a_voxel_size_that_is_none_is_refused_before_the_service_is_asked(canopy, tmp_path, metres):
    url = "http://127.0.0.1:1"
    code, _, stderr = canopy("scan", "--url", url, "-o", tmp_path, "--voxel", metres)
    assert code == 2
    assert "--voxel" in stderr


def test_canopy_says_of_every_vertex_how_it_is_known(canopy, recording, tmp_path):
    assert canopy("replay", recording, "-o", tmp_path, "--method", "canopy", "--rooted")[0] == 0
    document = from_json((tmp_path / "sticks.skeleton.json").read_bytes())
    assert document.method.name == "canopy"
    assert document.components == 1
    assert {"observed", "link"} <= set(document.extra["source"])
    summary = json.loads((tmp_path / "sticks.summary.json").read_text())
    assert summary["poses"] == []
    assert set(summary["seconds"]) >= {"read", "observe", "evidence", "likelihood", "canopy"}


def test_the_same_recording_gives_the_same_bytes(canopy, recording, tmp_path):
    for out in ("one", "other"):
        canopy("replay", recording, "-o", tmp_path / out, "--formats", "json,glb,swc,ply,csv")
    for path in (tmp_path / "one").iterdir():
        if path.name != "sticks.summary.json":
            assert path.read_bytes() == (tmp_path / "other" / path.name).read_bytes()


def test_json_on_stdout_is_all_there_is_on_stdout(canopy, recording, tmp_path):
    code, stdout, _ = canopy("replay", recording, "-o", tmp_path, "--json")
    assert code == 0
    (result,) = json.loads(stdout)
    assert result["views_used"] == 3
    assert all(Path(file).exists() for file in result["files"])


def test_methods_differ_and_say_who_they_are(canopy, recording, tmp_path):
    def made(name, *arguments):
        assert canopy("replay", recording, "-o", tmp_path / name, *arguments)[0] == 0
        data = (tmp_path / name / "sticks.skeleton.json").read_bytes()
        return from_json(data).method.name, data

    methods = ("canopy", "paper", "mst", "ftsem")
    results = {name: made(name, "--method", name) for name in methods}
    assert tuple(name for name, _ in results.values()) == methods
    assert made("default") == results["canopy"]


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["--method", "best"], "unknown method 'best': choose one of canopy, paper, mst, ftsem"),
        (["--method", "paper", "--rooted"], "for method canopy; leave them out with paper"),
        (["--method", "mst", "--no-fragments"], "for method canopy; leave them out with mst"),
        (["--segmenter", "eyes"], "unknown segmenter 'eyes': choose one of recorded"),
        (["--formats", "json,obj"], "unknown format 'obj': choose from json"),
        (["--voxel", "0"], "voxel size 0.0 m: give a length above 0"),
        (["--voxel", "-0.01"], "voxel size -0.01 m: give a length above 0"),
        (["--voxel", "0.00001"], " m fits"),
        (["--topic", "colour=/rgb"], "--topic colour=/rgb: give ROLE=NAME with a role of"),
        (["--topic", "max_pair_gap_ns=soon"], "give whole nanoseconds"),
    ],
)
def test_wrong_arguments_are_usage_errors(canopy, recording, tmp_path, arguments, says):
    out = tmp_path / "out"
    code, stdout, stderr = canopy("replay", recording, "-o", out, *arguments)
    assert code == 2
    assert stdout == ""
    (line,) = stderr.splitlines()
    assert line.startswith("error: ")
    assert says in line
    assert not out.exists() or list(out.iterdir()) == []


def test_a_replay_loses_only_the_view_for_which_the_map_has_no_room(tmp_path):
    wide = np.zeros((240, 320), np.uint16)
    wide[100:130, 10:310] = 1
    far = np.full((240, 320), 2.5, np.float32)
    path = tmp_path / "wide.mcap"
    write(path, [view_from(0), view_from(1, instances=wide, depth_m=far), view_from(2, z=0.1)])
    request = ReplayRequest(
        config=MethodConfig(name="paper"),
        segmenter="recorded",
        formats=("json",),
        topics=None,
        memory_limit_bytes=150 << 20,
    )
    document = replay(path, tmp_path, request, lambda done, total: None).document
    assert document.views_used == 2
    ((index, reason),) = [(view.index, view.reason) for view in document.views_rejected]
    assert (index, " m fits" in reason) == (1, True)


def test_an_output_folder_that_cannot_be_written_is_found_before_the_work(canopy, recording):
    code, _, stderr = canopy("replay", recording, "-o", recording / "inside")
    assert code == 2
    assert "cannot write there" in stderr
    assert "choose another output folder" in stderr


@pytest.mark.parametrize(
    ("content", "says"), [(None, "nothing.mcap"), (b"not a recording at all" * 20, "nothing.mcap")]
)
def test_a_recording_that_is_none_fails_in_one_line(canopy, tmp_path, content, says):
    path = tmp_path / "nothing.mcap"
    if content:
        path.write_bytes(content)
    code, _, stderr = canopy("replay", path, "-o", tmp_path / "out")
    assert code == 1
    (line,) = stderr.splitlines()
    assert says in line
    assert list((tmp_path / "out").iterdir()) == []


def test_one_bad_recording_does_not_cost_the_others(canopy, recording, tmp_path):
    code, stdout, stderr = canopy(
        "replay", tmp_path / "missing.mcap", recording, "-o", tmp_path / "out", "--json"
    )
    assert code == 3
    missing, good = json.loads(stdout)
    assert "missing.mcap" in missing["error"]
    assert good["views_used"] == 3
    assert "missing.mcap" in stderr


def test_two_recordings_of_one_name_would_overwrite_each_other(canopy, recording, tmp_path):
    code, _, stderr = canopy("replay", recording, recording, "-o", tmp_path / "out")
    assert code == 2
    assert "sticks" in stderr


def test_a_bad_view_is_left_out_and_said(canopy, tmp_path):
    path = tmp_path / "partly.mcap"
    write(path, [view_from(0), view_from(1, scores=(0.9,)), view_from(2, z=0.1)])
    code, stdout, stderr = canopy("replay", path, "-o", tmp_path / "out", "--json")
    assert code == 3
    (result,) = json.loads(stdout)
    assert (result["views_used"], result["views_rejected"]) == (2, 1)
    assert "view 1" in stderr
    document = from_json((tmp_path / "out" / "partly.skeleton.json").read_bytes())
    assert [view.index for view in document.views_rejected] == [1]


def test_a_recording_without_any_branch_says_why_it_found_none(canopy, tmp_path):
    path = tmp_path / "blind.mcap"
    far = np.full((240, 320), 50.0, np.float32)
    write(path, [view_from(0, depth_m=far)])
    code, _, stderr = canopy("replay", path, "-o", tmp_path / "out")
    assert code == 3
    assert "no branch was found in 3 instances (3 x too few points" in stderr


def test_no_usable_view_is_a_failure_and_writes_nothing(canopy, tmp_path):
    path = tmp_path / "none.mcap"
    write(path, [view_from(0, scores=None, instances=None)])
    code, _, stderr = canopy("replay", path, "-o", tmp_path / "out")
    assert code == 1
    assert "/camera/branches/instances" in stderr
    assert list((tmp_path / "out").iterdir()) == []


def test_a_truncated_recording_is_used_as_far_as_it_goes_and_can_be_recovered(
    canopy, recording, tmp_path
):
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(recording.read_bytes()[: int(recording.stat().st_size * 0.6)])
    code, stdout, stderr = canopy("replay", cut, "-o", tmp_path / "out", "--json")
    assert code == 3
    assert "cut off" in stderr
    used = json.loads(stdout)[0]["views_used"]
    assert 0 < used < 3
    whole = tmp_path / "whole.mcap"
    code, stdout, _ = canopy("recover", cut, whole, "--json")
    assert code == 3
    assert json.loads(stdout)["views_saved"] == used
    canopy("replay", whole, "-o", tmp_path / "out")
    one = from_json((tmp_path / "out" / "cut.skeleton.json").read_bytes())
    other = from_json((tmp_path / "out" / "whole.skeleton.json").read_bytes())
    np.testing.assert_array_equal(one.position, other.position)


def test_recovering_what_lacks_nothing_is_no_partial_success(canopy, recording, tmp_path):
    whole = tmp_path / "whole.mcap"
    assert canopy("recover", recording, whole)[0] == 0
    assert whole.stat().st_size > 0


def test_inspect_says_what_is_there(canopy, recording):
    code, stdout, _ = canopy("inspect", recording, "--json")
    assert code == 0
    facts = json.loads(stdout)
    assert facts["scan_id"] == "sticks-1"
    assert [view["index"] for view in facts["views"]] == [0, 1, 2]
    assert {t["topic"] for t in facts["topics"]} >= {"/camera/color/image", "/tf"}
    code, stdout, _ = canopy("inspect", recording)
    assert "3 usable views" in stdout


def test_score_of_a_skeleton_against_itself_is_perfect(canopy, recording, tmp_path):
    canopy("replay", recording, "-o", tmp_path)
    document = tmp_path / "sticks.skeleton.json"
    code, stdout, _ = canopy("score", document, document, "--json")
    assert code == 0
    scores = json.loads(stdout)
    assert (scores["precision"], scores["recall"], scores["acyclic"]) == (1.0, 1.0, True)
    code, stdout, _ = canopy("score", document, document)
    assert "precision" in stdout


def test_score_says_when_a_recording_has_no_truth(canopy, recording, tmp_path):
    canopy("replay", recording, "-o", tmp_path)
    code, _, stderr = canopy("score", tmp_path / "sticks.skeleton.json", recording)
    assert code == 1
    assert "no ground_truth_skeleton.json is attached" in stderr


def test_export_makes_the_other_formats_from_a_document(canopy, recording, tmp_path):
    canopy("replay", recording, "-o", tmp_path, "--formats", "json,glb")
    canopy("export", tmp_path / "sticks.skeleton.json", "-o", tmp_path / "more", "--formats", "glb")
    made = (tmp_path / "more" / "sticks.skeleton.glb").read_bytes()
    assert made == (tmp_path / "sticks.skeleton.glb").read_bytes()


def test_doctor_finds_this_machine_fit(canopy):
    code, stdout, _ = canopy("doctor", "--json")
    assert code == 0
    assert all(finding["ok"] for finding in json.loads(stdout))


def test_the_command_is_installed():
    command = Path(sys.executable).with_name("canopy")
    result = subprocess.run([command, "--help"], capture_output=True, text=True, check=True)
    for verb in ("replay", "inspect", "score", "recover", "export", "doctor"):
        assert verb in result.stdout


def test_the_bundled_recording_is_the_one_in_the_index_and_becomes_a_tree(canopy, tmp_path):
    (entry,) = tomllib.loads((ROOT / "recordings/index.toml").read_text())["recording"]
    demo = ROOT / "recordings" / entry["file"]
    assert sha256(demo.read_bytes()).hexdigest() == entry["sha256"]
    assert demo.stat().st_size <= 3_000_000
    code, _, _ = canopy("replay", demo, "-o", tmp_path)
    assert code == 0
    code, stdout, _ = canopy("score", tmp_path / "demo_apple.skeleton.json", demo, "--json")
    scores = json.loads(stdout)
    assert scores["precision"] > 0.95
    assert scores["recall"] > 0.6
    assert scores["acyclic"]
