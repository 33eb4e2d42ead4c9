"""A file of one JSON object a line, which any interruption leaves usable."""

import json
import os
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

from mock_hw.orchard.workers import hold


def read_lines(path: Path) -> list[bytes]:
    """Return the lines of a file, none where there is no file; a line cut off is taken away."""
    if not path.exists():
        return []
    data = path.read_bytes()
    whole = data[: data.rfind(b"\n") + 1]
    if len(whole) < len(data):
        os.truncate(path, len(whole))
    return whole.splitlines()


@contextmanager
def adding_lines(path: Path) -> Iterator[Callable[[Mapping[str, object]], None]]:
    """Hold a file for further lines; each is on disk when its call returns.

    Raises:
        UsageError: another process holds it.
    """
    with path.open("ab") as stream:
        hold(stream.fileno(), path)

        def add(fields: Mapping[str, object]) -> None:
            stream.write(json.dumps(fields).encode() + b"\n")
            stream.flush()
            os.fsync(stream.fileno())

        yield add
