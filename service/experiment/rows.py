"""One row per tree, segmenter and method, kept in a file that any interruption leaves usable."""

import json
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from canopy_skel.errors import UsageError
from service.experiment.orchard import Tree
from service.lines import adding_lines, read_lines
from service.sources import sources_sha256

Value = float | int | bool | str | None
_SHORT = 12
_MADE_BY = "service.experiment.measure"


@dataclass(frozen=True, kw_only=True, slots=True)
class Row:
    """What a method made of a tree with a segmenter's masks.

    values: scores and other figures by name; only `error` where it failed.
    """

    tree: Tree
    segmenter: str
    method: str
    config_sha256: str
    values: Mapping[str, Value]

    @property
    def key(self) -> str:
        """Return what the row follows from: recording, segmenter, method with settings, code."""
        return key_of(self.tree, self.segmenter, self.method, self.config_sha256)

    @property
    def failed(self) -> bool:
        """Whether there are no figures."""
        return "error" in self.values

    def number(self, name: str) -> float | None:
        """Return a figure, None where the row has none."""
        value = self.values.get(name)
        return None if value is None or isinstance(value, str) else float(value)

    def flat(self) -> dict[str, Value]:
        """Return everything in one level, for a table of all rows."""
        tree: dict[str, Value] = {name: getattr(self.tree, name) for name in Tree.__slots__}
        tree["simulated_v_det"] = tree.pop("v_det")
        own = {"segmenter": self.segmenter, "method": self.method}
        return {**tree, **own, "config_sha256": self.config_sha256, **self.values}


def key_of(tree: Tree, segmenter: str, method: str, config_sha256: str) -> str:
    """Return the key of a row; see `Row.key`."""
    parts = (
        tree.sha256[:_SHORT],
        segmenter,
        method,
        config_sha256[:_SHORT],
        experiment_sha256(segmenter, method)[:_SHORT],
    )
    return "/".join(parts)


def experiment_sha256(segmenter: str, method: str) -> str:
    """Return the hash of all code and data that rows of a method and a segmenter follow from."""
    return sources_sha256(_MADE_BY, segmenter, method)


class RowStore:
    """Rows by key in a file of one JSON object a line; only one process may write it."""

    def __init__(self, path: Path) -> None:
        """Read the rows that are there; a line that was cut off is taken away.

        Raises:
            UsageError: the file is no row store.
        """
        self._path = path
        self._rows: dict[str, Row] = {}
        for number, line in enumerate(read_lines(path), start=1):
            self._read(line, number)

    def __contains__(self, key: str) -> bool:
        """Whether a row with figures is there; what failed is tried again."""
        return key in self._rows and not self._rows[key].failed

    def get(self, keys: Iterable[str]) -> list[Row]:
        """Return the rows that are there, in the order of the keys."""
        return [self._rows[key] for key in keys if key in self._rows]

    @contextmanager
    def adding(self) -> Iterator[Callable[[Row], None]]:
        """Open the file for further rows."""
        with adding_lines(self._path) as add_line:

            def add(row: Row) -> None:
                fields = {
                    "key": row.key,
                    "tree": {name: getattr(row.tree, name) for name in Tree.__slots__},
                    "segmenter": row.segmenter,
                    "method": row.method,
                    "config_sha256": row.config_sha256,
                    "values": dict(row.values),
                }
                add_line(fields)
                self._rows[row.key] = row

            yield add

    def _read(self, line: bytes, number: int) -> None:
        try:
            fields = json.loads(line)
            key = fields.pop("key")
            tree = Tree(**fields.pop("tree"))
            self._rows[key] = Row(tree=tree, **fields)
        except (ValueError, KeyError, TypeError) as error:
            raise UsageError(
                f"{self._path}: line {number} is no row of an experiment ({error}); give another"
                " output folder, or delete the file to start over"
            ) from error
