"""What a row of figures follows from: the modules that make it, and the data they read."""

import ast
from collections.abc import Iterator
from functools import cache
from hashlib import sha256
from importlib.metadata import version
from importlib.resources import files
from importlib.resources.abc import Traversable

_METHOD_ALONE = {
    "canopy": tuple(
        f"canopy_skel.{name}" for name in ("assemble", "canopy", "confidence", "poses", "wood")
    ),
}
"""Modules that a method's settings or dispatch mention but no other method runs."""
_SEGMENTER_ALONE = {
    "unet": ("canopy_skel.segmenters.unet",),
    "maskrcnn": ("canopy_skel.segmenters.maskrcnn",),
}
_DATA = {"canopy": "canopy_skel/models", "unet": "canopy_skel/segmenters/unet"}
_UNCONCERNED = ("drivers.oak", "drivers.ur5")
_FOLLOWED = ("canopy_skel.", "drivers.", "service.")


@cache
def sources_sha256(start: str, segmenter: str, method: str) -> str:
    """Return the hash of the version, and of all code and data that a row depends on.

    `start` is the module that makes it. Rows stay good when code changes that they do not run: that
    of another method or segmenter.
    """
    others = [
        module
        for alone, own in ((_METHOD_ALONE, method), (_SEGMENTER_ALONE, segmenter))
        for name, modules in alone.items()
        if name != own
        for module in modules
    ]
    digest = sha256(version("canopy-skel").encode())
    for module in sorted(_reached(start, (*others, *_UNCONCERNED))):
        digest.update(module.encode() + b"\0" + _source(module) + b"\0")
    for name in (method, segmenter):
        for path, data in _data(name):
            digest.update(path.encode() + b"\0" + data + b"\0")
    return digest.hexdigest()


def _reached(start: str, left_out: tuple[str, ...]) -> set[str]:
    """Return the modules that one imports, directly or not, without going into some."""
    found: set[str] = set()
    ahead = [start]
    while ahead:
        module = ahead.pop()
        if module in found or any(f"{module}.".startswith(f"{name}.") for name in left_out):
            continue
        found.add(module)
        ahead += _imported(module)
    return found


@cache
def _imported(module: str) -> tuple[str, ...]:
    names: list[str] = []
    for node in ast.walk(ast.parse(_source(module))):
        if isinstance(node, ast.Import):
            names += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module:
            names += [node.module, *(f"{node.module}.{alias.name}" for alias in node.names)]
    return tuple(name for name in names if name.startswith(_FOLLOWED) and _file(name) is not None)


def _file(module: str) -> Traversable | None:
    package, *rest = module.split(".")
    folder = files(package).joinpath(*rest)
    if folder.is_dir():
        return folder / "__init__.py"
    source = files(package).joinpath(*rest[:-1], f"{rest[-1]}.py")
    return source if source.is_file() else None


def _source(module: str) -> bytes:
    source = _file(module)
    if source is None:
        raise ModuleNotFoundError(f"no module {module}")
    return source.read_bytes()


def _data(name: str) -> Iterator[tuple[str, bytes]]:
    if name in _DATA:
        package, *rest = _DATA[name].split("/")
        for entry in sorted(files(package).joinpath(*rest).iterdir(), key=lambda e: e.name):
            if entry.is_file() and not entry.name.endswith(".py"):
                yield f"{_DATA[name]}/{entry.name}", entry.read_bytes()
