"""Files that are there whole or not at all."""

import os
import tempfile
from collections.abc import Iterable, Mapping
from pathlib import Path

from canopy_skel.errors import UsageError


def require_writable(directory: Path) -> None:
    """Make a folder and check that files can be written there, before any work is done.

    Raises:
        UsageError: it is not a folder, or cannot be written.
    """
    try:
        directory.mkdir(parents=True, exist_ok=True)
        with tempfile.NamedTemporaryFile(dir=directory):
            pass
    except OSError as error:
        raise UsageError(
            f"{directory}: cannot write there ({error.strerror}); choose another output folder"
        ) from error


def write_all(directory: Path, contents: Mapping[str, bytes]) -> list[Path]:
    """Write files by name; each is complete before it gets its name.

    Raises:
        UsageError: the folder cannot be written; files already written are whole.
    """
    written = []
    for name, content in contents.items():
        target = directory / name
        part = _part(directory, name)
        try:
            part.write_bytes(content)
            os.replace(part, target)
        except OSError as error:
            part.unlink(missing_ok=True)
            raise UsageError(
                f"{target}: cannot be written ({error.strerror}); free space or choose another"
                " output folder"
            ) from error
        written.append(target)
    return written


def remove_parts(directory: Path, names: Iterable[str]) -> None:
    """Remove what a process that was killed had begun to write of files of these names."""
    for name in names:
        _part(directory, name).unlink(missing_ok=True)


def _part(directory: Path, name: str) -> Path:
    return directory / f".{name}.part"
