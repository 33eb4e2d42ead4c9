"""One row per recording, kept in a file that any interruption leaves usable."""

import csv
import io
import json
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

from canopy_skel.errors import UsageError
from service.lines import adding_lines, read_lines

Status = Literal["ok", "partial", "failed"]


@dataclass(frozen=True, kw_only=True, slots=True)
class Row:
    """What became of a recording.

    recording: its name in the batch. key: of settings and code; see `work.key_of`. size_bytes,
    modified_ns, sha256: of the recording; 0 and empty where it was not read. files: what was
    written, by name. warnings: what was wrong but did not matter, views left out among it.
    """

    recording: str
    key: str
    size_bytes: int = 0
    modified_ns: int = 0
    sha256: str = ""
    seconds: float = 0.0
    files: tuple[str, ...] = ()
    views_used: int = 0
    views_rejected: int = 0
    branches: int = 0
    components: int = 0
    length_m: float = 0.0
    warnings: tuple[str, ...] = ()
    error: str = ""

    @property
    def status(self) -> Status:
        """As the exit code of a replay says it."""
        if self.error:
            return "failed"
        return "partial" if self.warnings else "ok"

    def shown(self) -> dict[str, object]:
        """Return what a reader wants to know; figures only where there are any."""
        figures = {
            "views_used": self.views_used,
            "views_rejected": self.views_rejected,
            "branches": self.branches,
            "components": self.components,
            "length_m": self.length_m,
        }
        return {
            "recording": self.recording,
            "status": self.status,
            **(dict.fromkeys(figures) if self.error else figures),
            "seconds": self.seconds,
            "warnings": list(self.warnings),
            "error": self.error,
        }


class RowStore:
    """The newest row of each recording."""

    def __init__(self, path: Path, add_line: Callable[[Mapping[str, object]], None]) -> None:
        """Read the rows that are there; `add_line` adds to the file.

        Raises:
            UsageError: the file is no row store.
        """
        self._add_line = add_line
        self._rows: dict[str, Row] = {}
        for number, line in enumerate(read_lines(path), start=1):
            try:
                self._read(json.loads(line))
            except (ValueError, KeyError, TypeError) as error:
                raise UsageError(
                    f"{path}: line {number} is no row of a batch ({error}); give another output"
                    " folder, or delete the file to start over"
                ) from error

    def get(self, name: str) -> Row | None:
        """Return the row of a recording, None if there is none."""
        return self._rows.get(name)

    def begin(self, name: str) -> None:
        """Note that files of a recording may change from now on: its row is good no more."""
        self._add_line({"recording": name})
        self._rows.pop(name, None)

    def add(self, row: Row) -> None:
        """Keep a row."""
        self._add_line(asdict(row))
        self._rows[row.recording] = row

    def _read(self, fields: dict[str, Any]) -> None:
        if fields.keys() == {"recording"}:
            self._rows.pop(fields["recording"], None)
            return
        lists = {name: tuple(fields[name]) for name in ("files", "warnings")}
        row = Row(**{**fields, **lists})
        self._rows[row.recording] = row


@contextmanager
def row_store(path: Path) -> Iterator[RowStore]:
    """Open a row store; nobody else can meanwhile.

    Raises:
        UsageError: somebody has it open, or the file is none.
    """
    with adding_lines(path) as add_line:
        yield RowStore(path, add_line)


def rows_csv(rows: Iterable[Row]) -> bytes:
    """Return rows as a table."""
    out = io.StringIO()
    names = list(Row(recording="", key="").shown())
    writer = csv.DictWriter(out, names, lineterminator="\n")
    writer.writeheader()
    for row in rows:
        writer.writerow({**row.shown(), "warnings": "; ".join(row.warnings)})
    # A file may have a name that is no text.
    return out.getvalue().encode(errors="backslashreplace")
