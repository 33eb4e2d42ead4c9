"""The figures this project stands for, on recordings that nobody here made."""

import json

import pytest

NAMES = ("apple_fd2", "oak_fd3", "apple_dense")
FLOORS = {  # precision, directional precision
    "apple_fd2": (0.95, 0.90),
    "oak_fd3": (0.90, 0.86),
    "apple_dense": (0.80, 0.75),
}
CANOPY_FLOORS = {
    "apple_fd2": (0.95, 0.90),
    "oak_fd3": (0.90, 0.86),
    "apple_dense": (0.90, 0.88),
}


@pytest.fixture(scope="module")
def out(tmp_path_factory):
    return tmp_path_factory.mktemp("out")


@pytest.fixture
def scores_of(out, shared_recording, canopy):
    def run(*arguments):
        code, stdout, _ = canopy(*arguments)
        assert code == 0
        return stdout

    def scores(name, method):
        path, folder = shared_recording(name), out / method
        if not (folder / f"{name}.skeleton.json").exists():
            run("replay", path, "-o", folder, "--method", method, "--formats", "json", "--json")
        return json.loads(run("score", folder / f"{name}.skeleton.json", path, "--json"))

    return scores


@pytest.mark.parametrize("name", NAMES)
def test_the_paper_mode_reaches_its_floors(scores_of, name):
    scores = scores_of(name, "paper")
    precision, directional = FLOORS[name]
    assert scores["precision"] >= precision
    assert scores["precision_directional"] >= directional
    assert scores["recall_masked"] >= 0.95
    assert scores["length_ratio"] <= 1.15
    assert scores["acyclic"]


@pytest.mark.parametrize("baseline", ["mst", "ftsem"])
@pytest.mark.parametrize("name", NAMES)
def test_the_paper_mode_is_not_below_the_baselines(scores_of, name, baseline):
    assert scores_of(name, "paper")["precision"] >= scores_of(name, baseline)["precision"]


@pytest.mark.parametrize("name", NAMES)
def test_the_canopy_mode_reaches_its_floors(scores_of, name):
    scores = scores_of(name, "canopy")
    precision, directional = CANOPY_FLOORS[name]
    assert scores["precision"] >= precision
    assert scores["precision_directional"] >= directional
    assert scores["recall_masked"] >= 0.97
    assert scores["length_ratio"] <= 1.1
    assert scores["ece"] <= 0.08
    assert scores["acyclic"]


@pytest.mark.parametrize("name", NAMES)
def test_canopy_sees_more_than_paper_and_says_how_sure_it_is(scores_of, name):
    paper, canopy = scores_of(name, "paper"), scores_of(name, "canopy")
    assert canopy["recall"] >= 1.08 * paper["recall"]
    assert canopy["recall_unmasked"] >= 1.5 * paper["recall_unmasked"]


def test_most_gaps_are_joined(scores_of):
    joined = [scores_of(name, "paper")["joined"] for name in NAMES]
    assert sum(joined) / len(joined) >= 0.6


def test_a_stereo_recording_becomes_a_skeleton_too(scores_of):
    scores = scores_of("walnut_stereo", "paper")
    assert scores["precision"] >= 0.9
    assert scores["recall_masked"] >= 0.95
    assert scores["length_ratio"] <= 1.15
