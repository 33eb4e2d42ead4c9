"""Rows are made again when, and only when, something they follow from changes."""

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
SCRIPT = """
import sys
from service.sources import sources_sha256
print(sources_sha256(*sys.argv[1:]))
"""
EXPERIMENT, BATCH = "service.experiment.measure", "service.batch.work"
PAPER = (EXPERIMENT, "recorded", "paper")
CANOPY = (EXPERIMENT, "recorded", "canopy")
UNET = (EXPERIMENT, "unet", "paper")
REPLAYED = (BATCH, "recorded", "paper")
ROWS = [PAPER, CANOPY, UNET, REPLAYED]


def hashes(folder: Path) -> dict[tuple[str, ...], str]:
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
        ("canopy_skel/metrics/scores.py", {PAPER, CANOPY, UNET}),
        ("canopy_skel/links.py", {CANOPY}),
        ("canopy_skel/models/canopy-confidence.json", {CANOPY}),
        ("canopy_skel/segmenters/unet/grouping.py", {UNET}),
        ("canopy_skel/segmenters/unet/builtin.pt", {UNET}),
        ("drivers/ur5/messages.py", set()),
        ("canopy_skel/exports/gltf.py", {REPLAYED}),
        ("service/replay.py", {REPLAYED}),
        ("service/scan.py", set()),
    ],
)
def test_a_row_follows_from_the_code_and_the_data_it_runs(
    copied: Path, file: str, changed: set[tuple[str, ...]]
) -> None:
    before = hashes(copied)
    original = (copied / file).read_bytes()
    (copied / file).write_bytes(original + b"\n")
    try:
        after = hashes(copied)
    finally:
        (copied / file).write_bytes(original)
    assert {row for row in ROWS if before[row] != after[row]} == changed
