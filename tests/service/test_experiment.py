import csv
import json
import shutil
from hashlib import sha256

import numpy as np
import pytest

from canopy_skel.document import to_json
from canopy_skel.frame import Intrinsics
from canopy_skel.recording import RecordingWriter
from mock_hw.orchard.camera import Camera
from mock_hw.orchard.simulate import Options, prepare, truth, views
from service.experiment.orchard import Tree
from service.experiment.published import published
from service.experiment.rows import Row
from service.experiment.segmenters import degradation, segmenter_named
from service.experiment.table import Rows, mean_of

LENS = Intrinsics(fx_px=330.0, fy_px=330.0, cx_px=240.0, cy_px=150.0, width_px=480, height_px=300)
TREES = (("apple", 0, 3), ("oak", 0, 3), ("walnut", 1, 4))
LEAVES = {"apple": 600, "oak": 2500, "walnut": 300}


@pytest.fixture(scope="module")
def grown(tmp_path_factory):
    """Three small trees, and a manifest that knows the first two."""
    folder = tmp_path_factory.mktemp("orchard")
    entries = []
    for species, topology, foliage in TREES:
        scan = prepare(
            Options(
                species=species,
                topology=topology,
                leaf_count=LEAVES[species],
                views=10,
                rows=False,
                camera=Camera(intrinsics=LENS),
            )
        )
        path = folder / f"{species}_{topology:03d}_fd{foliage}.mcap"
        with RecordingWriter(path, {"scan_id": scan.scan_id}) as writer:
            for view in views(scan):
                if view.index % 5 == 1:
                    writer.write_view(view)
            data = to_json(truth(scan))
            writer.attach("ground_truth_skeleton.json", "application/json", data)
        digest = sha256(path.read_bytes()).hexdigest()
        entries.append(
            {"file": path.name, "sha256": digest, "leaf_count": LEAVES[species], "v_det": 0.5}
        )
    (folder / "manifest.json").write_text(json.dumps({"recordings": entries[:2]}))
    return folder


@pytest.fixture
def orchard(grown, tmp_path):
    folder = tmp_path / "orchard"
    shutil.copytree(grown, folder)
    return folder


def rows_in(out):
    with (out / "rows.csv").open() as stream:
        return list(csv.DictReader(stream))


def test_the_small_experiment_from_recordings_to_page(canopy, grown, tmp_path):
    out = tmp_path / "out"
    segmenters = "recorded,drop50+false20"
    methods = ("--methods", "paper,mst,ftsem")
    arguments = ("experiment", "paper-table", "--orchard", grown, "-o", out, *methods)
    choice = ("--segmenters", segmenters, "--jobs", 2, "--json")
    code, stdout, stderr = canopy(*arguments, *choice)
    summary = json.loads(stdout)
    missing = {"apple_000_fd4", "apple_001_fd3", "apple_001_fd4", "oak_000_fd4", "oak_001_fd3"}
    assert code == 3  # The full grid of what is there has twelve trees.
    assert missing < set(summary["missing"])
    assert len(summary["missing"]) == 9
    assert "not there yet: apple_000_fd4" in stderr
    assert (summary["trees"], summary["rows"], summary["failed"]) == (3, 18, [])
    pictures = [
        "over_foliage",
        "over_degradation",
        "example_apple",
        "example_oak",
        "example_walnut",
    ]
    names = ["paper_table.md", "rows.csv", *(f"{name}.png" for name in pictures)]
    assert summary["files"] == [str(out / name) for name in names]
    for name in pictures:
        assert (out / f"{name}.png").read_bytes()[:4] == b"\x89PNG"
    rows = rows_in(out)
    assert [row["v_det"] for row in rows[:1]] != [""]
    assert {(row["species"], row["segmenter"], row["method"]) for row in rows} == {
        (species, segmenter, method)
        for species, _, _ in TREES
        for segmenter in segmenters.split(",")
        for method in ("paper", "mst", "ftsem")
    }
    assert [row["leaf_count"] for row in rows if row["species"] == "walnut"] == [""] * 6
    page = (out / "paper_table.md").read_text()
    assert f"--segmenters {segmenters}" in page
    oak = next(row for row in rows if row["species"] == "oak" and row["method"] == "mst")
    assert "| oak | 3 | 1 | " in page
    assert f" {float(oak['precision']):.3f} | {float(oak['recall']):.3f} |" in page
    assert_rows_are_what_replay_and_score_say(canopy, grown, rows, tmp_path)
    assert_nothing_is_made_twice(canopy, arguments, segmenters, out)


def assert_rows_are_what_replay_and_score_say(canopy, grown, rows, tmp_path):
    recording = grown / "oak_000_fd3.mcap"
    for method in ("paper", "ftsem"):
        canopy("replay", recording, "-o", tmp_path / method, "--method", method)
        skeleton = tmp_path / method / "oak_000_fd3.skeleton.json"
        scores = json.loads(canopy("score", skeleton, recording, "--json")[1])
        (row,) = [
            row
            for row in rows
            if (row["file"], row["method"], row["segmenter"])
            == (recording.name, method, "recorded")
        ]
        for name, value in scores.items():
            if isinstance(value, float):
                # The document that replay writes is rounded to 0.01 mm.
                assert float(row[name]) == pytest.approx(value, abs=2e-3), name


def assert_nothing_is_made_twice(canopy, arguments, segmenters, out):
    before = (out / "rows.csv").read_bytes()
    store = out / "rows.jsonl"
    whole = store.read_bytes()
    store.write_bytes(whole[:-40])  # Killed while the last row was written.
    again = ("--segmenters", segmenters, "--no-figures", "--jobs", 1)
    canopy(*arguments, *again)
    assert (out / "rows.csv").read_bytes() == before
    lines = store.read_bytes().splitlines()
    assert lines[:-1] == whole.splitlines()[:-1]
    assert len(lines) == 18
    canopy(*arguments, *again)
    assert len(store.read_bytes().splitlines()) == 18


def test_a_tree_that_cannot_be_used_is_named_and_the_others_are_there(canopy, orchard, tmp_path):
    (orchard / "oak_000_fd3.mcap").write_bytes(b"no recording at all")
    (orchard / "notes.mcap").write_bytes(b"")
    out = tmp_path / "out"
    code, _, stderr = canopy(
        *("experiment", "paper-table", "--orchard", orchard, "-o", out, "--methods", "mst"),
        *("--segmenters", "recorded,drop50", "--no-figures", "--jobs", 1, "--topologies", "0"),
    )
    assert code == 3
    assert "oak_000_fd3.mcap: is not what manifest.json says" in stderr
    assert "notes.mcap: left out, its name is not like oak_003_fd2.mcap" in stderr
    assert "oak_000_fd3, recorded, mst: " in stderr
    assert (out / "paper_table.md").read_text().count("Failed: oak_000_fd3: ") == 1
    apple, _, oak, _ = rows_in(out)
    assert apple["precision"]
    assert oak["error"]
    assert not oak["precision"]


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (["--methods", "best"], "unknown method 'best'"),
        (["--segmenters", "drop120"], "unknown segmenter 'drop120'"),
        (["--segmenters", "drop5false5"], "unknown segmenter 'drop5false5'"),
        (["--segmenters", ""], "give at least one method and one segmenter"),
        (["--topologies", "0-x"], "'0-x': give numbers as 0,3,5-7"),
        (["--topologies", "9-0"], "'9-0': 9-0 is no range; give the smaller number first"),
        (["--topologies", "0-999999999999"], "0-999999999999 is no range"),
        (["--species", "palm"], "no chosen recording named like oak_003_fd2.mcap"),
        (["--jobs", "0"], "0 jobs: give 1 or more"),
    ],
)
def test_bad_arguments_are_refused_before_any_work(canopy, grown, tmp_path, arguments, complaint):
    code, _, stderr = canopy(
        *("experiment", "paper-table", "--orchard", grown, "-o", tmp_path / "out"), *arguments
    )
    assert code == 2
    assert complaint in stderr


@pytest.mark.parametrize("text", ["[1]", '{"recordings": 3}', "{", '{"recordings": [{}]}'])
def test_a_manifest_that_is_none_is_refused(canopy, orchard, tmp_path, text):
    (orchard / "manifest.json").write_text(text)
    code, _, stderr = canopy(
        "experiment", "paper-table", "--orchard", orchard, "-o", tmp_path / "out"
    )
    assert code == 2
    assert "manifest.json: not the manifest of an orchard" in stderr


def test_a_row_store_that_is_none_is_refused(canopy, grown, tmp_path):
    (tmp_path / "rows.jsonl").write_text('{"other": 1}\n')
    code, _, stderr = canopy("experiment", "paper-table", "--orchard", grown, "-o", tmp_path)
    assert code == 2
    assert "rows.jsonl: line 1 is no row of an experiment" in stderr


@pytest.mark.parametrize(
    ("name", "shares"),
    [
        ("recorded", (0, 0)),
        ("drop25", (25, 0)),
        ("false20", (0, 20)),
        ("drop25+false20", (25, 20)),
        ("drop", None),
        ("drop25+", None),
        ("", None),
    ],
)
def test_names_of_degraded_masks(name, shares):
    assert degradation(name) == shares
    if shares not in (None, (0, 0)):
        segmenter = segmenter_named(name)
        assert (segmenter.drop_share * 100, segmenter.false_share * 100) == shares


def row(topology, method, precision):
    tree = Tree(species="oak", topology=topology, foliage=3, file="x", sha256=str(topology))
    return Row(
        tree=tree,
        segmenter="recorded",
        method=method,
        config_sha256="0",
        values={"precision": precision},
    )


def test_means_carry_the_standard_error_of_the_topologies():
    values = [0.9, 0.8, 0.95, None]
    mean = mean_of(values)
    assert mean.mean == pytest.approx(np.mean(values[:3]))
    assert mean.error == pytest.approx(np.std(values[:3], ddof=1) / np.sqrt(3))
    assert str(mean) == "0.883 ±.044"
    assert str(mean_of([0.5])) == "0.500"
    assert mean_of([None]) is None


def test_differences_are_taken_on_the_same_trees():
    paper = [row(0, "paper", 0.9), row(1, "paper", 0.7), row(2, "paper", 0.1)]
    mst = [row(1, "mst", 0.6), row(0, "mst", 0.8)]
    difference = Rows.of(paper + mst).difference("precision", "paper", "mst")
    assert difference.mean == pytest.approx(0.1)
    assert difference.error == pytest.approx(0.0, abs=1e-12)
    assert difference.count == 2


def test_the_papers_numbers_have_the_means_its_text_gives():
    numbers = published()
    assert len(numbers) == 12 * 3 * 3
    for figure, mean in (("precision", 0.98), ("recall", 0.59)):
        ours = [value for key, value in numbers.items() if key[2:] == ("paper", figure)]
        assert np.mean(ours) == pytest.approx(mean, abs=0.005)
