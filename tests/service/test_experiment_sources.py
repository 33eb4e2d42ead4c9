"""Rows of an experiment are made again when, and only when, something they follow from changes."""

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
SCRIPT = """
import sys
from service.experiment.rows import experiment_sha256
print(experiment_sha256(sys.argv[1], sys.argv[2]))
"""
ROWS = [("recorded", "paper"), ("recorded", "canopy"), ("unet", "paper")]


def hashes(folder: Path) -> dict[tuple[str, str], str]:
    """Return the hash of each of `ROWS` by the packages of a folder."""
    return {
        row: subprocess.run(
            [sys.executable, "-c", SCRIPT, *row],
            cwd=folder,
            env={"PYTHONPATH": str(folder)},
            capture_output=True,
            text=True,
            check=True,
        ).stdout
        for row in ROWS
    }


@pytest.fixture(scope="module")
def copied(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("packages")
    for package in ("canopy_skel", "drivers", "service"):
        shutil.copytree(
            ROOT / package, folder / package, ignore=shutil.ignore_patterns("__pycache__")
        )
    return folder


@pytest.mark.parametrize(
    ("file", "changed"),
    [
        ("canopy_skel/likelihood.py", {*ROWS}),
        ("canopy_skel/kernels/search.py", {*ROWS}),
        ("canopy_skel/metrics/scores.py", {*ROWS}),
        ("canopy_skel/links.py", {("recorded", "canopy")}),
        ("canopy_skel/models/canopy-confidence.json", {("recorded", "canopy")}),
        ("canopy_skel/segmenters/unet/grouping.py", {("unet", "paper")}),
        ("canopy_skel/segmenters/unet/builtin.pt", {("unet", "paper")}),
        ("drivers/ur5/messages.py", set()),
        ("canopy_skel/exports/gltf.py", set()),
    ],
)
def test_a_row_follows_from_the_code_and_the_data_it_runs(
    copied: Path, file: str, changed: set[tuple[str, str]]
) -> None:
    before = hashes(copied)
    original = (copied / file).read_bytes()
    (copied / file).write_bytes(original + b"\n")
    try:
        after = hashes(copied)
    finally:
        (copied / file).write_bytes(original)
    assert {row for row in ROWS if before[row] != after[row]} == changed
