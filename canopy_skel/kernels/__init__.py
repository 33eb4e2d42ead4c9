"""Compiled kernels. A module of them is imported, and so compiled, when it is first used.

Importing the method therefore compiles nothing, and no method waits for kernels of another.
"""

from importlib import import_module
from pkgutil import iter_modules

MODULES = frozenset(info.name for info in iter_modules(__path__)) - {"compiled"}

_OF_ALL = frozenset({"blocks", "ellipsoid", "forest", "sums"})
_OF_JOINERS = _OF_ALL | {"fit", "parts", "smooth", "strip", "trust", "unions"}
NEEDED_BY = {
    "canopy": _OF_ALL
    | {
        "agree",
        "aligning",
        "around",
        "bark",
        "candidates",
        "colours",
        "components",
        "fuse",
        "profile",
        "verdicts",
    },
    "paper": _OF_JOINERS | {"joins", "search"},
    "mst": _OF_JOINERS,
    "ftsem": _OF_JOINERS,
    "unet": frozenset({"strands", "strips"}),
}
"""The modules that each method uses, and each segmenter; what those import is not listed."""


class _UntilUsed:
    """Stands for a module of this package in those that import it."""

    def __init__(self, name: str) -> None:
        self._name = f"{__name__}.{name}"

    def __getattr__(self, name: str) -> object:
        return getattr(import_module(self._name), name)


def __getattr__(name: str) -> _UntilUsed:
    if name not in MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return _UntilUsed(name)
