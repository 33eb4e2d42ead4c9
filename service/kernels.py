"""The compiled kernels, made on all cores the first time.

Numba compiles a module as it is imported, on one core, and keeps the result on disk. Here every
module is imported in some process of its own first, so that a first start waits half as long on
two cores; and only those that are about to be used. Run as `python -m service.kernels` after
installing: that compiles all.

Tried, to no gain: Numba's lower levels of optimisation (level 1 saves a tenth, of slower kernels),
no vectorisers, no checks for division by zero, inner functions inlined before typing (all of them:
slower; only those with one caller: 3 to 7 % of their module).
"""

import gc
import hashlib
import importlib
import multiprocessing
import os
import signal
import sys
from collections.abc import Iterable
from importlib.resources import files
from pathlib import Path

from canopy_skel.kernels import MODULES, NEEDED_BY

PACKAGE = "canopy_skel.kernels"
STAMP = "canopy-kernels.sha256"
"""Beside the kernels: of which sources they were made."""


def compile_kernels(needed_by: Iterable[str]) -> None:
    """Have on disk what methods and segmenters of these names need; those not listed need none."""
    compile_modules(frozenset().union(*(NEEDED_BY.get(name, ()) for name in needed_by)))


def compile_modules(names: Iterable[str]) -> None:
    """Have kernels of these modules on disk; nothing to do where they are or may not be written.

    A module counts as compiled if any kernel of it is there. What is missing then is compiled when
    it is used, on one core.
    """
    source, kept = Path(str(files(PACKAGE))), _kept_in()
    if not _may_write(kept) or os.environ.get("NUMBA_DISABLE_JIT", "0") != "0":
        return
    _remove_outdated(source, kept)
    compiled = {path.name.split(".")[0] for path in kept.rglob("*.nbi")}
    missing = sorted(set(names) - compiled)
    if not missing:
        return
    # The largest first: they take longest.
    missing.sort(key=lambda name: -(source / f"{name}.py").stat().st_size)
    print("compiling the kernels, once", file=sys.stderr)  # noqa: T201 - before any other output
    spawn = multiprocessing.get_context("spawn")
    with spawn.Pool(min(os.cpu_count() or 1, len(missing), 8), initializer=_prepare) as pool:
        pool.map(_import, missing, chunksize=1)


def _prepare() -> None:
    # What compiling makes lives as long as the process: looking for garbage takes a tenth of it.
    gc.disable()
    # Ctrl-C reaches all processes; the first of them ends the others.
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def _import(name: str) -> None:
    importlib.import_module(f"{PACKAGE}.{name}")


def _remove_outdated(source: Path, kept: Path) -> None:
    """Remove what other sources gave than those of today.

    Numba looks at the file of a kernel only, and not at those of kernels that it calls: after an
    update it would run some as they were and others as they are.
    """
    texts = (path.name.encode() + path.read_bytes() for path in sorted(source.glob("*.py")))
    digest, stamp = hashlib.sha256(b"".join(texts)).hexdigest(), kept / STAMP
    if stamp.exists() and stamp.read_text() == digest:
        return
    for path in [*kept.rglob("*.nbi"), *kept.rglob("*.nbc")]:
        if path.name.split(".")[0] in MODULES:
            path.unlink(missing_ok=True)
    stamp.write_text(digest)


def _may_write(kept: Path) -> bool:
    try:
        kept.mkdir(parents=True, exist_ok=True)
    except OSError:
        return False
    return os.access(kept, os.W_OK)


def _kept_in() -> Path:
    """Return the folder numba keeps these kernels in."""
    elsewhere = os.environ.get("NUMBA_CACHE_DIR")
    return Path(elsewhere) if elsewhere else Path(str(files(PACKAGE))) / "__pycache__"


if __name__ == "__main__":
    compile_modules(MODULES)
