"""The first start compiles everything once, on all cores."""

import os
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]


def run(folder: Path, *arguments: str) -> str:
    return subprocess.run(
        [sys.executable, *arguments],
        cwd=ROOT,
        env={**os.environ, "NUMBA_CACHE_DIR": str(folder)},
        capture_output=True,
        text=True,
        check=True,
    ).stderr


def compiled(folder: Path) -> set[str]:
    return {path.name for path in folder.rglob("*.nb[ic]")}


def test_nothing_is_left_for_imports_to_compile(tmp_path):
    assert "compiling the kernels, once" in run(tmp_path, "-m", "service.kernels")
    before = compiled(tmp_path)
    assert len({name.split(".")[0] for name in before}) >= 12  # Modules.
    run(tmp_path, "-c", "import canopy_skel.pipeline, canopy_skel.volume")
    assert compiled(tmp_path) == before


def test_a_second_start_compiles_nothing(tmp_path):
    (tmp_path / "joins.spread-1.py311.nbi").touch()
    assert run(tmp_path, "-m", "service.kernels") == ""
    assert len(compiled(tmp_path)) == 1
