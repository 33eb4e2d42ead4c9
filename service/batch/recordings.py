"""Which recordings a batch is of, and where the results of each go."""

import os
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePath

from canopy_skel.errors import UsageError


@dataclass(frozen=True, kw_only=True, slots=True)
class Found:
    """A recording. name: its path below the folder that was given; results go there, too."""

    path: Path
    name: PurePath


def find_recordings(paths: Sequence[Path]) -> list[Found]:
    """Return the recordings that are named, and those in the folders named; each once.

    Raises:
        UsageError: one is not there, a folder has none, or results would overwrite each other.
    """
    found: dict[Path, Found] = {}
    for path in paths:
        for one in _found_at(path):
            found.setdefault(one.path, one)
    _require_distinct(found.values())
    return list(found.values())


def _found_at(path: Path) -> list[Found]:
    if not path.exists():
        raise UsageError(f"{path}: no such file or folder; give recordings, or folders of them")
    if not path.is_dir():
        return [Found(path=_absolute(path), name=PurePath(path.name))]
    found = [
        Found(path=_absolute(one), name=one.relative_to(path)) for one in sorted(_visible(path))
    ]
    if not found:
        raise UsageError(f"{path}: no *.mcap is in it; give recordings, or folders of them")
    return found


def _absolute(path: Path) -> Path:
    # Without following links: their names, not those of what they point at, say where results go.
    return Path(os.path.abspath(path))


def _visible(folder: Path) -> Iterator[Path]:
    """Yield the recordings below a folder, without what other systems hide beside them."""
    for path in folder.rglob("*.mcap"):
        if not any(part.startswith(".") for part in path.relative_to(folder).parts):
            yield path


def _require_distinct(found: Iterable[Found]) -> None:
    by_stem: dict[PurePath, Found] = {}
    for one in found:
        other = by_stem.setdefault(one.name.with_suffix(""), one)
        if other is not one:
            raise UsageError(
                f"{other.path} and {one.path}: their results would overwrite each other; give the"
                " folder above both instead, or batch them into different folders"
            )
