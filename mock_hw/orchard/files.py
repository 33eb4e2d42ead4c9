"""Files that are there whole or not at all, also after a power cut."""

import os
from collections.abc import Iterable
from pathlib import Path

from canopy_skel.errors import RecordingError


def write_whole(path: Path, parts: Iterable[bytes]) -> None:
    """Write a file under another name, and give it its own when it is on disk.

    Raises:
        RecordingError: it cannot be written.
    """
    unfinished = path.with_name(f".{path.name}.part")
    try:
        with unfinished.open("wb") as stream:
            stream.writelines(parts)
            stream.flush()
            os.fsync(stream.fileno())
        os.replace(unfinished, path)
    except OSError as error:
        unfinished.unlink(missing_ok=True)
        raise RecordingError(
            f"{path}: cannot be written ({error.strerror}); check the disk, and run again to go on"
        ) from error
