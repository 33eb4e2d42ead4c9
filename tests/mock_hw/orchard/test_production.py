import json
import os
import shutil
import signal
from dataclasses import asdict, replace

import numpy as np
import pytest

from canopy_skel.document import from_json
from canopy_skel.errors import RecordingError, UsageError
from canopy_skel.recording import read_recording
from mock_hw.orchard.census import as_table, density_rows
from mock_hw.orchard.dataset import (
    MANIFEST,
    LeafyTree,
    Recorded,
    Settings,
    flaw_of,
    leafy_trees,
    read_manifest,
    recorded_in,
    sha256_of,
    write_manifest,
)
from mock_hw.orchard.foliage import FoliageFit
from mock_hw.orchard.production import produce
from mock_hw.orchard.record import segmented_share
from mock_hw.orchard.simulate import fit_densities, prepare, shots, truth

SETTINGS = Settings(picture_scale=0.125, seed=5, wind_m=0.01)
SOFTWARE = "canopy-skel test"
TREES = leafy_trees(["walnut"], [3], [1, 4])


def run(folder, wanted=TREES, settings=SETTINGS, jobs=1, software=SOFTWARE):
    return list(produce(folder, wanted, settings, software=software, jobs=jobs))


def contents(folder):
    return {path.name: path.read_bytes() for path in folder.iterdir()}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("orchard")
    assert [one.made for one in run(path)] == [True, True]
    return path


@pytest.fixture
def copy(folder, tmp_path):
    return shutil.copytree(folder, tmp_path / "copy")


@pytest.mark.parametrize("species", ["apple", "oak", "walnut"])
def test_the_instances_of_full_pictures_cover_v_det_of_the_tree(species):
    (fit,) = fit_densities(species, 1, [3])
    assert fit.v_det == pytest.approx(fit.target, abs=0.03)
    options = replace(
        LeafyTree(species=species, topology=1, foliage=3).options(Settings()), rows=False
    )
    assert segmented_share(truth(prepare(options, fit))) == fit.v_det


def test_the_first_tree_of_every_species_comes_first():
    wanted = leafy_trees(["apple", "oak"], [0, 1], [2, 3])
    assert [tree.file for tree in wanted[:5]] == [
        "apple_000_fd2.mcap",
        "apple_000_fd3.mcap",
        "oak_000_fd2.mcap",
        "oak_000_fd3.mcap",
        "apple_001_fd2.mcap",
    ]


def test_the_manifest_says_what_is_there(folder):
    manifest = read_manifest(folder)
    assert manifest["software"] == SOFTWARE
    assert manifest["settings"] == asdict(SETTINGS)
    assert set(contents(folder)) == {MANIFEST, *(tree.file for tree in TREES)}
    for entry, tree in zip(manifest["recordings"], TREES, strict=True):
        assert (entry["species"], entry["topology"], entry["foliage"]) == (
            "walnut",
            3,
            tree.foliage,
        )
        assert entry["sha256"] == sha256_of(folder / entry["file"])
        assert entry["options"] == asdict(SETTINGS)
        assert entry["views"] == 10
        assert entry["v_det"] == pytest.approx(entry["v_det_target"], abs=0.03)
    assert manifest["recordings"][0]["leaf_count"] < manifest["recordings"][1]["leaf_count"]


def test_a_recording_holds_the_views_and_the_truth_of_the_simulation(folder):
    entry = read_manifest(folder)["recordings"][0]
    recording = read_recording(folder / entry["file"])
    assert recording.warnings == ()
    assert recording.metadata["tree_id"] == "walnut_003"
    assert recording.metadata["software"] == SOFTWARE
    assert json.loads(recording.metadata["simulation"]) == {
        **asdict(TREES[0]),
        **asdict(SETTINGS),
    }
    fit = FoliageFit(density=1, leaf_count=entry["leaf_count"], v_det=0.7, target=0.7)
    simulation = prepare(TREES[0].options(SETTINGS), fit)
    assert recording.scan_id == simulation.scan_id
    for view, shot in zip(recording.views(), shots(simulation), strict=True):
        assert np.array_equal(view.instances, shot.view.instances)
        assert view.scores == shot.view.scores
        assert view.stamp_ns == shot.view.stamp_ns
        assert view.base_from_camera == pytest.approx(shot.view.base_from_camera, abs=1e-9)
        assert np.allclose(view.depth_m, shot.view.depth_m, rtol=0, atol=6e-4, equal_nan=True)
    attached = from_json(recording.ground_truth)
    expected = truth(simulation)
    assert np.allclose(attached.position, expected.position, rtol=0, atol=1e-5)
    assert np.array_equal(attached.occluded, expected.occluded)
    assert attached.extra["segmented"] == expected.extra["segmented"]
    assert entry["segmented"] == pytest.approx(segmented_share(expected), abs=1e-6)


def test_what_is_damaged_or_was_not_listed_when_it_was_killed_is_made_again(folder, copy):
    manifest = read_manifest(copy)
    del manifest["recordings"][0]
    (copy / MANIFEST).write_text(json.dumps(manifest))
    data = bytearray((copy / TREES[1].file).read_bytes())
    data[len(data) // 2] ^= 1
    (copy / TREES[1].file).write_bytes(data)
    (copy / ".unfinished-killed").mkdir()
    (copy / ".unfinished-killed" / TREES[0].file).write_bytes(b"half")
    assert [one.made for one in run(copy, jobs=2)] == [True, True]
    assert contents(copy) == contents(folder)


def test_a_check_names_what_is_missing_or_damaged(copy):
    (copy / TREES[0].file).unlink()
    (copy / TREES[1].file).write_bytes(b"")
    assert [flaw_of(copy, one) for one in recorded_in(read_manifest(copy))] == [
        f"{copy / TREES[0].file}: cannot be read (No such file or directory)",
        f"{copy / TREES[1].file}: has other bytes than the manifest says",
    ]


def test_a_finished_data_set_is_left_as_it_is(folder):
    before = contents(folder)
    assert [one.made for one in run(folder)] == [False, False]
    assert contents(folder) == before
    run(folder, wanted=TREES[:1])
    assert contents(folder) == before


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"settings": replace(SETTINGS, noise="bad")}, "is of noise nominal, not bad; choose"),
        ({"software": "canopy-skel 9"}, "is of canopy-skel test, not canopy-skel 9; choose"),
    ],
)
def test_other_recordings_in_the_folder_are_not_touched(folder, change, message):
    before = contents(folder)
    with pytest.raises(UsageError, match=message):
        run(folder, **change)
    assert contents(folder) == before


def test_a_recording_of_somebody_else_is_not_replaced(tmp_path):
    (tmp_path / TREES[0].file).write_bytes(b"precious")
    with pytest.raises(UsageError, match=r"walnut_003_fd1.mcap: is there already and was not made"):
        run(tmp_path)
    assert contents(tmp_path) == {TREES[0].file: b"precious"}


def test_two_runs_do_not_share_a_folder(folder):
    first = produce(folder, TREES, SETTINGS, software=SOFTWARE, jobs=1)
    next(first)
    with pytest.raises(UsageError, match="another canopy writes there"):
        run(folder)
    first.close()
    assert len(run(folder)) == 2


@pytest.mark.parametrize(
    "text", ["", "[]", '{"schema": "other"}', '{"schema": "canopy-orchard/1", "recordings": [{}]}']
)
def test_a_manifest_that_is_none_is_named(tmp_path, text):
    (tmp_path / MANIFEST).write_text(text)
    with pytest.raises(UsageError, match=r"manifest.json: is no canopy-orchard/1 manifest"):
        run(tmp_path)


def test_a_manifest_with_an_entry_of_another_type_is_named(tmp_path):
    entry = Recorded(
        file="walnut_003_fd1.mcap",
        sha256="0",
        bytes=1,
        species="walnut",
        topology=3,
        foliage=1,
        views=10,
        leaf_count=5,
        v_det=0.7,
        v_det_target=0.7,
        segmented=0.6,
    )
    write_manifest(tmp_path, [entry], SETTINGS, SOFTWARE)
    manifest = read_manifest(tmp_path)
    for name in asdict(entry):
        entries = [{**manifest["recordings"][0], name: None}]
        (tmp_path / MANIFEST).write_text(json.dumps({**manifest, "recordings": entries}))
        with pytest.raises(UsageError, match=r"manifest.json: is no canopy-orchard/1 manifest"):
            read_manifest(tmp_path)


def test_a_killed_worker_is_one_clear_error(tmp_path, monkeypatch):
    monkeypatch.setattr("mock_hw.orchard.production.fit_densities", _die)
    with pytest.raises(RecordingError, match="was killed, perhaps for want of memory"):
        run(tmp_path)
    assert json.loads((tmp_path / MANIFEST).read_text())["recordings"] == []


def _die(*_):
    os.kill(os.getpid(), signal.SIGKILL)


def test_rows_name_the_worst_tree_of_each_density(folder):
    recordings = recorded_in(read_manifest(folder))
    worse = replace(recordings[0], file="walnut_004_fd1.mcap", topology=4, v_det=0.62)
    rows = density_rows([*recordings, worse])
    assert [(row.species, row.foliage, row.trees) for row in rows] == [
        ("walnut", 1, 2),
        ("walnut", 4, 1),
    ]
    assert rows[0].worst_file == worse.file
    assert rows[0].worst_miss == pytest.approx(0.08)
    assert "| walnut | 1 | 2 |" in as_table(rows)
