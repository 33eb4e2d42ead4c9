"""The compiled kernels, made on all cores the first time.

Numba compiles a module as it is imported, on one core, and keeps the result on disk. Here every
module is imported in some process of its own first, so that a first start waits half as long on
two cores. Run as `python -m service.kernels` after installing.

Tried, to no gain: Numba's lower levels of optimisation (level 1 saves a tenth, of slower kernels),
no vectorisers, no checks for division by zero, inner functions inlined before typing (all of them:
slower; only those with one caller: 3 to 7 % of their module).
"""

import gc
import importlib
import multiprocessing
import os
import pkgutil
import sys
from collections.abc import Collection
from importlib.resources import files
from pathlib import Path

PACKAGE = "canopy_skel.kernels"
SELDOM = frozenset({"centreline", "strands", "volume"})
"""Only learned masks and scores need these: a first start does not wait for them."""


def compile_kernels(leaving_out: Collection[str] = SELDOM) -> None:
    """Have kernels on disk; returns at once where any is there already, or none may be written.

    What is left out, missing or out of date then is compiled on import, as ever.
    """
    folder = _kept_in()
    if not os.access(folder.parent, os.W_OK) or any(folder.rglob("*.nbi")):
        return
    print("compiling the kernels, once", file=sys.stderr)  # noqa: T201 - before any other output
    spawn = multiprocessing.get_context("spawn")
    # What compiling makes lives as long as the process: looking for garbage takes a tenth of it.
    with spawn.Pool(min(os.cpu_count() or 1, 8), initializer=gc.disable) as pool:
        pool.map(_import, modules(leaving_out), chunksize=1)


def modules(leaving_out: Collection[str] = ()) -> list[str]:
    """Return the names of all modules of kernels, the largest first: they take longest."""
    folder = Path(str(files(PACKAGE)))
    found = [info.name for info in pkgutil.iter_modules([str(folder)])]
    found.sort(key=lambda name: -(folder / f"{name}.py").stat().st_size)
    return [f"{PACKAGE}.{name}" for name in found if name not in leaving_out]


def _import(module: str) -> None:
    importlib.import_module(module)


def _kept_in() -> Path:
    """Return the folder numba keeps these kernels in."""
    elsewhere = os.environ.get("NUMBA_CACHE_DIR")
    return Path(elsewhere) if elsewhere else Path(str(files(PACKAGE))) / "__pycache__"


if __name__ == "__main__":
    compile_kernels(leaving_out=())
