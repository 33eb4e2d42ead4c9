"""Does this machine have what canopy needs?"""

import os
import platform
import shutil
import sys
import tempfile
from dataclasses import asdict, dataclass
from importlib.metadata import PackageNotFoundError, requires, version
from pathlib import Path

from packaging.requirements import Requirement

from canopy_skel import kernels

ENOUGH_MEMORY = 2 << 30
ENOUGH_DISK = 1 << 30


@dataclass(frozen=True, slots=True)
class Finding:
    """One thing looked at: whether it will do, and what was found or what to mend."""

    name: str
    ok: bool
    detail: str

    def to_dict(self) -> dict[str, object]:
        """Return the fields, ready for JSON."""
        return asdict(self)


def examine() -> list[Finding]:
    """Look at everything canopy needs."""
    return [
        _python(),
        *(_package(name) for name in needed_packages()),
        _memory(),
        _disk(Path.cwd()),
        _kernel_cache(),
    ]


def needed_packages() -> list[str]:
    """Return the names of the packages canopy is declared to need here."""
    declared = [Requirement(line) for line in requires("canopy-skel") or []]
    return [
        one.name for one in declared if one.marker is None or one.marker.evaluate({"extra": ""})
    ]


def available_memory_bytes() -> int:
    """Return the memory that can be had without swapping, or all of it where that is not told."""
    info = Path("/proc/meminfo")
    if info.exists():
        for line in info.read_text().splitlines():
            if line.startswith("MemAvailable:"):
                return int(line.split()[1]) * 1024
    return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")


def _python() -> Finding:
    return Finding("python", sys.version_info >= (3, 11), f"{platform.python_version()} (>= 3.11)")


def _package(name: str) -> Finding:
    try:
        return Finding(name, True, version(name))
    except PackageNotFoundError:
        return Finding(name, False, "not installed; run `make setup`")


def _memory() -> Finding:
    available = available_memory_bytes()
    return Finding("memory", available >= ENOUGH_MEMORY, f"{available / 2**30:.1f} GiB (>= 2)")


def _disk(folder: Path) -> Finding:
    free = shutil.disk_usage(folder).free
    return Finding("disk", free >= ENOUGH_DISK, f"{free / 2**30:.1f} GiB free here (>= 1)")


def _kernel_cache() -> Finding:
    """Kernels are compiled once, if their cache can be written."""
    folder = Path(os.environ.get("NUMBA_CACHE_DIR") or Path(kernels.__file__).parent)
    try:
        with tempfile.NamedTemporaryFile(dir=folder):
            return Finding("kernel cache", True, f"{folder} can be written")
    except OSError:
        mend = "every start compiles anew; set NUMBA_CACHE_DIR to a folder that can be written"
        return Finding("kernel cache", False, f"{folder} cannot be written: {mend}")
