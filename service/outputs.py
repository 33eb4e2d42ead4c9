"""Files that are there whole or not at all."""

import os
import tempfile
from collections.abc import Mapping
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
        part = directory / f".{name}.part"
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
