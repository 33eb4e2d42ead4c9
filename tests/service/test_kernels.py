"""The first start compiles everything once, on all cores."""

import os
import subprocess
import sys
from pathlib import Path

from service.kernels import PACKAGE, SELDOM, modules

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
    start = "from service.kernels import compile_kernels; compile_kernels()"
    assert "compiling the kernels, once" in run(tmp_path, "-c", start)
    before = compiled(tmp_path)
    assert len({name.split(".")[0] for name in before}) >= 12  # Modules.
    run(tmp_path, "-c", "import service.cli, service.worker")
    assert compiled(tmp_path) == before


def test_installing_compiles_what_few_need_as_well():
    seldom = {f"{PACKAGE}.{name}" for name in SELDOM}
    assert len(seldom) == 3
    assert set(modules()) - set(modules(SELDOM)) == seldom


def test_all_kernels_say_what_types_they_take():
    """Then importing compiles them, and the first view does not wait."""
    script = (
        "import importlib, sys\n"
        "for name in sys.argv[1:]:\n"
        "    module = importlib.import_module(name)\n"
        "    for one in vars(module).values():\n"
        "        if hasattr(one, 'py_func') and not one.signatures:\n"
        "            sys.exit(f'{name}.{one.__name__} has no signature')\n"
    )
    asked = subprocess.run(
        [sys.executable, "-c", script, *modules()], cwd=ROOT, capture_output=True, text=True
    )
    assert (asked.returncode, asked.stderr) == (0, "")


def test_a_second_start_compiles_nothing(tmp_path):
    (tmp_path / "joins.spread-1.py311.nbi").touch()
    assert run(tmp_path, "-m", "service.kernels") == ""
    assert len(compiled(tmp_path)) == 1
