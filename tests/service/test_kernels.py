"""A first start compiles what it needs, once, on all cores; nothing waits for the rest."""

import importlib
import os
import signal
import subprocess
import sys
import time
from functools import cache
from pathlib import Path

import pytest

from canopy_skel.errors import UsageError
from canopy_skel.kernels import MODULES, NEEDED_BY
from canopy_skel.kernels.compiled import kernel
from canopy_skel.pipeline import METHODS
from service.kernels import STAMP, compile_modules

ROOT = Path(__file__).parents[2]
SELDOM = {"centreline", "volume"}
"""Only training and scores need these: they are compiled when they are used."""
REPLAY = (
    "import sys; from service.cli import main\n"
    f"sys.argv = ['canopy', 'replay', '{ROOT / 'recordings/demo_apple.mcap'}', *sys.argv[1:]]\n"
    "try: main()\n"
    "except SystemExit as end: assert not end.code, end.code\n"
)
LOADED = (
    "import sys\n"
    "start = 'canopy_skel.kernels.'\n"
    "print(*(m.removeprefix(start) for m in sys.modules if m.startswith(start)), file=sys.stderr)\n"
)


def run(folder: Path | None, *arguments: str) -> str:
    """Run a Python of its own, its kernels kept in a folder; return what it says on stderr."""
    kept = {} if folder is None else {"NUMBA_CACHE_DIR": str(folder)}
    done = subprocess.run(
        [sys.executable, *arguments],
        cwd=ROOT,
        env={**os.environ, **kept},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return done.stderr


def loaded(code: str, *arguments: str) -> set[str]:
    """Return the modules of kernels that code uses."""
    return set(run(None, "-c", code + LOADED, *arguments).splitlines()[-1].split()) - {"compiled"}


@cache
def importing(names: frozenset[str]) -> set[str]:
    """Return these modules of kernels and those they import."""
    return loaded("".join(f"import canopy_skel.kernels.{name}\n" for name in sorted(names)))


def compiled(folder: Path) -> dict[str, set[tuple[str, int]]]:
    """Return what is on disk of each module: names and times."""
    found: dict[str, set[tuple[str, int]]] = {}
    for path in folder.rglob("*.nb[ic]"):
        kept = found.setdefault(path.name.split(".")[0], set())
        kept.add((path.name, path.stat().st_mtime_ns))
    return found


def test_importing_the_program_compiles_nothing():
    assert loaded("import service.cli, service.worker, service.live\n") == set()


@pytest.mark.parametrize("method", METHODS)
def test_a_method_uses_the_kernels_it_is_said_to_need(method, tmp_path):
    used = loaded(REPLAY, "-o", str(tmp_path), "--method", method)
    assert used == importing(NEEDED_BY[method])


def test_a_first_replay_compiles_the_kernels_of_its_method_alone(tmp_path):
    kept, out = tmp_path / "kept", str(tmp_path)
    first = run(kept, "-c", REPLAY, "-o", out, "--method", "mst")
    assert first.count("compiling the kernels, once") == 1
    before = compiled(kept)
    assert set(before) == importing(NEEDED_BY["mst"])
    assert not set(before) & (NEEDED_BY["canopy"] - NEEDED_BY["mst"])
    assert "compiling" not in run(kept, "-c", REPLAY, "-o", out, "--method", "ftsem")
    assert compiled(kept) == before
    # Another method adds what it lacks.
    more = "from service.kernels import compile_kernels; compile_kernels(['paper', 'recorded'])"
    run(kept, "-c", more)
    after = compiled(kept)
    assert set(after) == importing(NEEDED_BY["paper"])
    assert before.items() <= after.items()


def test_every_module_is_needed_by_a_method_or_a_segmenter_or_seldom():
    assert importing(frozenset().union(*NEEDED_BY.values())) | SELDOM == MODULES


def test_a_worker_that_is_warm_has_the_kernels_of_all_methods():
    warm_up = (
        "from contextlib import nullcontext; from service.live import warm_up\n"
        "warm_up(lambda name: nullcontext())\n"
    )
    needed = frozenset().union(*(NEEDED_BY[method] for method in METHODS))
    assert loaded(warm_up) == importing(needed)


def test_all_kernels_say_what_types_they_take():
    """Then importing compiles them, and the first view does not wait."""
    for name in MODULES:
        module = importlib.import_module(f"canopy_skel.kernels.{name}")
        for one in vars(module).values():
            assert not hasattr(one, "py_func") or one.signatures, f"{name}.{one.__name__}"


def test_a_module_that_is_not_there_cannot_be_imported():
    with pytest.raises(ImportError, match="pathfinding"):
        from canopy_skel.kernels import pathfinding  # noqa: F401


def test_what_other_sources_gave_is_compiled_again(tmp_path):
    """Numba does not see that a kernel called from another file has changed."""
    one = "from service.kernels import compile_modules; compile_modules(['unions'])"
    assert "compiling the kernels, once" in run(tmp_path, "-c", one)
    before = compiled(tmp_path)
    assert run(tmp_path, "-c", one) == ""
    assert compiled(tmp_path) == before
    (tmp_path / STAMP).write_text("of last year")
    assert "compiling the kernels, once" in run(tmp_path, "-c", one)
    after = compiled(tmp_path)
    assert set(after) == set(before) == {"unions"}
    assert not after["unions"] & before["unions"]


def test_nothing_is_compiled_where_kernels_run_uncompiled(tmp_path, monkeypatch):
    monkeypatch.setenv("NUMBA_DISABLE_JIT", "1")
    assert run(tmp_path, "-m", "service.kernels") == ""


def test_without_a_folder_to_keep_kernels_in_the_mend_is_named():
    space = {"__name__": "nowhere"}
    exec(compile("def twice(n):\n    return 2 * n\n", "<nowhere>", "exec"), space)
    with pytest.raises(UsageError, match="set NUMBA_CACHE_DIR"):
        kernel("int64(int64)")(space["twice"])


def test_a_folder_for_kernels_is_made(tmp_path):
    start = "from service.kernels import compile_modules; compile_modules(['unions'])"
    assert "compiling the kernels, once" in run(tmp_path / "not" / "there", "-c", start)
    assert set(compiled(tmp_path)) == {"unions"}


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_worker_told_to_leave_while_it_compiles_takes_its_processes_along(number, tmp_path):
    where = ["--connect", "tcp/127.0.0.1:1", "--site", "site", "--rig", "rig"]
    with subprocess.Popen(
        [sys.executable, "-m", "service.worker", *where],
        cwd=ROOT,
        env={**os.environ, "NUMBA_CACHE_DIR": str(tmp_path)},
        stderr=subprocess.PIPE,
        text=True,
    ) as worker:
        assert worker.stderr.readline() == "compiling the kernels, once\n"
        while not compiled(tmp_path):
            time.sleep(0.1)
        worker.send_signal(number)
        # Ends when no process holds it any more.
        assert worker.stderr.read() == ""
    assert worker.returncode == 0


def test_installing_compiles_what_is_not_there_yet(tmp_path, monkeypatch):
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    compile_modules(())
    for name in MODULES - {"centreline"}:
        (tmp_path / f"{name}.any-1.py311.nbi").touch()
    before = set(compiled(tmp_path))
    assert "compiling the kernels, once" in run(tmp_path, "-m", "service.kernels")
    assert set(compiled(tmp_path)) == before | {"centreline"} == MODULES
    assert run(tmp_path, "-m", "service.kernels") == ""
