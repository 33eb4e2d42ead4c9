"""The experiment as a page of tables."""

import csv
import io
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from service.experiment.orchard import Orchard
from service.experiment.published import FIGURES, published
from service.experiment.rows import Row, experiment_sha256
from service.experiment.segmenters import degradation
from service.experiment.table import Mean, Rows

HEADS = {"precision": "P", "recall": "R", "osr": "OSR"}
DENSE = (3, 4)
EXTENDED = {
    "precision_directional": "P_dir",
    "precision_strict": "P strict",
    "recall_masked": "R masked",
    "recall_unmasked": "R unmasked",
    "recall_hidden": "R hidden",
    "v_det_ratio": "R / V_det",
    "occ_precision": "occ P",
    "osr_strict": "OSR strict",
    "joined": "joined",
    "length_ratio": "length ratio",
    "radius_error_median": "radius error",
    "volume_error": "volume error",
    "volume_found_error": "of found wood",
    "parent_correct": "parent correct",
    "components": "components",
    "ece": "ECE",
    "auc": "AUC",
}


@dataclass(frozen=True, kw_only=True, slots=True)
class Report:
    """What a page is made of: the command that was given, its orchard, methods, segmenters, rows.

    figures: names of the pictures beside the page, with what they show.
    """

    command: str
    orchard: Orchard
    methods: tuple[str, ...]
    segmenters: tuple[str, ...]
    rows: tuple[Row, ...]
    figures: tuple[tuple[str, str], ...]

    def page(self) -> str:
        """Return the page in Markdown."""
        rows = Rows.of(self.rows)
        sections = [self._head(rows)]
        first = self.segmenters[0]
        own = rows.where(segmenter=first)
        sections += [
            f"## Table I, segmenter `{first}`\n\n{table_one(own, self.methods)}",
            f"## Against the baselines at FD3 and FD4\n\n{against(own, self.methods)}",
            f"## Beside the paper's Table I\n\n{beside_the_paper(own, self.methods)}",
            f"## Beyond the paper's figures, segmenter `{first}`\n\n{extended(own, self.methods)}",
        ]
        if len(self.segmenters) > 1:
            sections.append(f"## Worse masks\n\n{by_segmenter(rows, self)}")
        sections += [f"## {title}\n\n![{title}]({name})" for name, title in self.figures]
        return "\n\n".join(sections) + "\n"

    def _head(self, rows: Rows) -> str:
        configs = {row.method: row.config_sha256 for row in self.rows}
        lines = [
            "# The paper's experiment on the synthetic orchard",
            "",
            f"`{self.command}`",
            "",
            f"{rows.trees} trees, {len(rows.rows)} rows; settings and code "
            + ", ".join(
                f"`{name}` {config[:12]} {experiment_sha256(self.segmenters[0], name)[:12]}"
                for name, config in configs.items()
            )
            + ". Means over topologies ± standard error; every figure is explained in the page on"
            " metrics, and every row is in `rows.csv`. Simulated trees only.",
        ]
        failed = dict.fromkeys(
            f"\nFailed: {row.tree.name}: {row.values['error']}" for row in self.rows if row.failed
        )
        lines += failed
        if self.orchard.missing:
            lines.append(f"\nNot there yet: {', '.join(self.orchard.missing)}.")
        return "\n".join(lines)


def table_one(rows: Rows, methods: Sequence[str]) -> str:
    """Return the paper's Table I: species x foliage density, each method's P, R and OSR."""
    head = [f"{method} {HEADS[figure]}" for method in methods for figure in FIGURES]
    body = []
    for species, foliage, some in _cells(rows):
        cells = [
            _shown(some.where(method=method).mean(figure))
            for method in methods
            for figure in FIGURES
        ]
        body.append([species, str(foliage), str(some.trees), *cells])
    means = [
        _shown(rows.where(method=method).mean(figure)) for method in methods for figure in FIGURES
    ]
    return _table(
        ["species", "FD", "trees", *head], [*body, ["**all**", "", str(rows.trees), *means]]
    )


def against(rows: Rows, methods: Sequence[str]) -> str:
    """Return the differences of ours to each baseline, tree by tree, where foliage is dense."""
    ours = [method for method in methods if method not in ("mst", "ftsem")]
    pairs = [(a, b) for a in ours for b in methods if b in ("mst", "ftsem")]
    body = []
    for species in rows.species:
        for foliage in [fd for fd in DENSE if fd in rows.foliage]:
            some = rows.where(species=species, foliage=[foliage])
            for a, b in pairs:
                cells = [_signed(some.difference(figure, a, b)) for figure in FIGURES]
                body.append([species, str(foliage), f"{a} − {b}", *cells])
    note = "Mean of the differences on the same trees ± its standard error.\n\n"
    return note + _table(["species", "FD", "", *HEADS.values()], body)


def beside_the_paper(rows: Rows, methods: Sequence[str]) -> str:
    """Return ours, the paper's number and the difference for each cell of Table I."""
    numbers = published()
    known = [method for method in methods if any(key[2] == method for key in numbers)]
    body = []
    for species, foliage, some in _cells(rows):
        cells = []
        for method in known:
            for figure in FIGURES:
                theirs = numbers.get((species, foliage, method, figure))
                ours = some.where(method=method).mean(figure)
                cells.append(_compared(ours, theirs))
        body.append([species, str(foliage), *cells])
    head = [f"{method} {HEADS[figure]}" for method in known for figure in FIGURES]
    return "Ours / the paper's (difference).\n\n" + _table(["species", "FD", *head], body)


def extended(rows: Rows, methods: Sequence[str]) -> str:
    """Return the extended figures by foliage density and method, over all species."""
    body = []
    for foliage in rows.foliage:
        for method in methods:
            some = rows.where(foliage=[foliage], method=method)
            cells = [_shown(some.mean(figure), plain=True) for figure in EXTENDED]
            body.append([str(foliage), method, *cells])
    return _table(["FD", "method", *EXTENDED.values()], body)


def by_segmenter(rows: Rows, report: Report) -> str:
    """Return precision, recall and OSR by segmenter and method over the trees that all have."""
    shared = set.intersection(
        *({row.tree.sha256 for row in rows.where(segmenter=s).rows} for s in report.segmenters)
    )
    common = Rows(tuple(row for row in rows.rows if row.tree.sha256 in shared))
    body = []
    for segmenter in report.segmenters:
        for method in report.methods:
            some = common.where(segmenter=segmenter, method=method)
            figures = (*FIGURES, "occ_precision", "joined", "precision_directional")
            body.append([segmenter, method, *(_shown(some.mean(figure)) for figure in figures)])
    note = (
        f"Over the {len(shared)} trees that have all of them. `dropN`: N % of each view's instances"
        " left out; `falseN`: N % false ones added along edges of leaves, wires and background.\n\n"
    )
    return note + _table(["segmenter", "method", *HEADS.values(), "occ P", "joined", "P_dir"], body)


def degradations(segmenters: Iterable[str]) -> dict[str, tuple[int, int]]:
    """Return percent dropped and false of those segmenters that are recorded masks or worse."""
    known = {name: degradation(name) for name in segmenters}
    return {name: shares for name, shares in known.items() if shares is not None}


def rows_csv(rows: Sequence[Row]) -> str:
    """Return all rows as CSV."""
    flat = [row.flat() for row in rows]
    names = list(dict.fromkeys(name for row in flat for name in row))
    out = io.StringIO()
    writer = csv.DictWriter(out, names, lineterminator="\n")
    writer.writeheader()
    for row in flat:
        writer.writerow(
            {k: f"{v:.6g}" if isinstance(v, float) else v for k, v in row.items() if v is not None}
        )
    return out.getvalue()


def _cells(rows: Rows) -> list[tuple[str, int, Rows]]:
    cells = [
        (species, foliage, rows.where(species=species, foliage=[foliage]))
        for species in rows.species
        for foliage in rows.foliage
    ]
    return [cell for cell in cells if cell[2].rows]


def _shown(mean: Mean | None, *, plain: bool = False) -> str:
    if mean is None:
        return "–"
    return f"{mean.mean:.3f}" if plain else str(mean)


def _signed(mean: Mean | None) -> str:
    return "–" if mean is None else f"{'+' if mean.mean >= 0 else ''}{mean}"


def _compared(ours: Mean | None, theirs: float | None) -> str:
    if ours is None or theirs is None:
        return _shown(ours, plain=True)
    return f"{ours.mean:.2f} / {theirs:.2f} ({ours.mean - theirs:+.2f})"


def _table(head: Sequence[str], body: Iterable[Sequence[str]]) -> str:
    lines = [head, ["---"] * len(head), *body]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)
