"""`canopy experiment`."""

import json
import shlex
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.progress import Progress, TaskID

from canopy_skel.errors import UsageError
from canopy_skel.pipeline import METHODS
from service.cli.shell import WIDEST_RANGE, AsJson, Exit, Out, progress_bars, stderr
from service.experiment.orchard import Choice, Orchard, read_orchard
from service.experiment.report import Report, rows_csv
from service.experiment.rows import Row, RowStore
from service.kernels import compile_kernels
from service.outputs import require_writable, write_all

if TYPE_CHECKING:
    from service.experiment.run import Experiment

STORE = "rows.jsonl"
SEGMENTERS = "recorded,false20,drop50,drop25+false20,drop50+false20"

experiment = typer.Typer(
    name="experiment", help="Compare methods on a simulated orchard.", no_args_is_help=True
)


@experiment.callback()
def _group() -> None:
    """Compare methods on a simulated orchard."""


@experiment.command("paper-table")
def paper_table(
    orchard: Annotated[Path, typer.Option(help="Folder of recordings made by canopy simulate.")],
    output: Out,
    methods: Annotated[str, typer.Option(help=f"Of {','.join(METHODS)}.")] = ",".join(METHODS),
    segmenters: Annotated[
        str, typer.Option(help="Where masks come from; the tables are of the first.")
    ] = SEGMENTERS,
    species: Annotated[str, typer.Option(help="Only these, e.g. oak,apple.")] = "",
    topologies: Annotated[str, typer.Option(help="Only these, e.g. 0-9 or 0,3,5-7.")] = "",
    foliage: Annotated[str, typer.Option(help="Only these densities, e.g. 3,4.")] = "",
    jobs: Annotated[int, typer.Option(help="How many processes.")] = 2,
    figures: Annotated[bool, typer.Option(help="Draw pictures too.")] = True,
    as_json: AsJson = False,
) -> None:
    """Make the paper's Table I, with errors, further figures and pictures.

    Rows that are there already are kept: after an interruption the same command goes on, and an
    orchard that still grows may be used at any time.
    """
    from service.experiment.run import Experiment, run

    choice = Choice(
        species=_names(species), topologies=_numbers(topologies), foliage=_numbers(foliage)
    )
    require_writable(output)
    if figures:
        _require_matplotlib()
    plan = Experiment(
        folder=orchard,
        orchard=read_orchard(orchard, choice),
        methods=_names(methods),  # type: ignore[arg-type]  # Experiment names the known ones
        segmenters=_names(segmenters),
        jobs=jobs,
    )
    store = RowStore(output / STORE)
    compile_kernels([*plan.methods, *plan.segmenters])
    with progress_bars() as progress:
        rows = run(plan, store, _show(progress, progress.add_task("trees", total=None)))
    options = {
        "methods": methods,
        "segmenters": segmenters,
        "species": species,
        "topologies": topologies,
        "foliage": foliage,
    }
    files = _write(output, _command(orchard, output, options), plan, rows, figures=figures)
    if as_json:
        typer.echo(json.dumps(_summary(plan, rows, files), indent=2))
    else:
        for file in files:
            typer.echo(file)
    raise typer.Exit(_complain(plan.orchard, rows))


def _command(orchard: Path, output: Path, options: dict[str, str]) -> str:
    """Return the command that makes this page, without the places of one machine."""
    words = ["canopy", "experiment", "paper-table", "--orchard", orchard.name, "-o", output.name]
    for name, value in options.items():
        words += [f"--{name}", value] if value else []
    return shlex.join(words)


def _write(
    output: Path, command: str, plan: "Experiment", rows: list[Row], *, figures: bool
) -> list[Path]:
    pictures: dict[str, tuple[str, bytes]] = {}
    if figures:
        # Imported here: it needs matplotlib, which few installations have.
        from service.experiment.pictures import draw_all

        pictures = draw_all(plan, rows)
    report = Report(
        command=command,
        orchard=plan.orchard,
        methods=plan.methods,
        segmenters=plan.segmenters,
        rows=tuple(rows),
        figures=tuple((name, title) for name, (title, _) in pictures.items()),
    )
    contents = {"paper_table.md": report.page().encode(), "rows.csv": rows_csv(rows).encode()}
    contents |= {name: data for name, (_, data) in pictures.items()}
    return write_all(output, contents)


def _require_matplotlib() -> None:
    if find_spec("matplotlib") is None:
        raise UsageError(
            "the pictures need matplotlib: pip install 'canopy-skel[experiment]', or give"
            " --no-figures"
        )


def _show(progress: Progress, task: TaskID) -> Callable[[int, int, str], None]:
    def show(done: int, total: int, tree: str) -> None:
        progress.update(task, completed=done, total=total)
        if tree and progress.disable:
            stderr.print(f"{done}/{total} {tree}", markup=False)

    return show


def _complain(orchard: Orchard, rows: list[Row]) -> Exit:
    failed = [row for row in rows if row.failed]
    for line in orchard.warnings:
        stderr.print(f"warning: {line}", style="yellow", markup=False)
    for row in failed:
        what = f"{row.tree.name}, {row.segmenter}, {row.method}: {row.values['error']}"
        stderr.print(f"warning: {what}", style="yellow", markup=False)
    if orchard.missing:
        stderr.print(f"not there yet: {', '.join(orchard.missing)}", markup=False)
    return Exit.PARTIAL if failed or orchard.missing or orchard.warnings else Exit.OK


def _summary(plan: "Experiment", rows: list[Row], files: list[Path]) -> dict[str, object]:
    return {
        "trees": len(plan.orchard.trees),
        "missing": list(plan.orchard.missing),
        "rows": len(rows),
        "failed": [
            {"tree": row.tree.name, "method": row.method, "error": row.values["error"]}
            for row in rows
            if row.failed
        ],
        "files": [str(file) for file in files],
    }


def _names(text: str) -> tuple[str, ...]:
    return tuple(dict.fromkeys(name.strip() for name in text.split(",") if name.strip()))


def _numbers(text: str) -> tuple[int, ...]:
    """Return the numbers that a list like 0,3,5-7 stands for.

    Raises:
        UsageError: it is no such list.
    """
    numbers: list[int] = []
    for part in _names(text):
        first, dash, last = part.partition("-")
        if not first.isdecimal() or (dash and not last.isdecimal()):
            raise UsageError(f"{text!r}: give numbers as 0,3,5-7")
        ends = int(first), int(last or first)
        if not 0 <= ends[1] - ends[0] < WIDEST_RANGE:
            raise UsageError(f"{text!r}: {part} is no range; give the smaller number first")
        numbers += range(ends[0], ends[1] + 1)
    return tuple(dict.fromkeys(numbers))
