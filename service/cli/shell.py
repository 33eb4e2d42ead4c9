"""What the verbs share: options, exit codes, progress and complaints on stderr."""

from collections.abc import Callable, Collection
from dataclasses import replace
from enum import IntEnum
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from canopy_skel.errors import CanopyError, UsageError
from canopy_skel.recording import TopicOptions

stderr = Console(stderr=True, highlight=False, soft_wrap=True)
AsJson = Annotated[bool, typer.Option("--json", help="Print the result as JSON on stdout.")]
FARTHEST_RANGE_M = (0.31, 20.0)
"""As over HTTP: from just beyond the nearest depth that is used."""


def within(least: float, most: float) -> Callable[[float], float]:
    """Return the check of an option; typer's own minimum and maximum let NaN pass."""

    def check(value: float) -> float:
        if not least <= value <= most:
            raise typer.BadParameter(f"{value} is not in the range {least} to {most}")
        return value

    return check


Farthest = Annotated[
    float,
    typer.Option(
        help="Wood farther from the camera (m) is another tree's.",
        callback=within(*FARTHEST_RANGE_M),
    ),
]
Out = Annotated[Path, typer.Option("-o", "--output", help="Folder for the results.")]

WIDEST_RANGE = 100_000
"""More numbers than anybody means by a range like 0-9."""


class Exit(IntEnum):
    """What a caller learns from the exit code."""

    OK = 0
    FAILED = 1
    USAGE = 2
    PARTIAL = 3


def overall(codes: Collection[Exit]) -> Exit:
    """Return the code of several: theirs where they agree."""
    return next(iter(codes)) if len(set(codes)) == 1 else Exit.PARTIAL


def progress_bars() -> Progress:
    """Return progress bars on stderr; silent where stderr is not a terminal."""
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn())
    quiet = not stderr.is_terminal
    return Progress(*columns, TimeElapsedColumn(), console=stderr, transient=True, disable=quiet)


def complain(error: CanopyError) -> None:
    """Say on stderr what is wrong and how to mend it."""
    stderr.print(f"error: {error}", style="red", markup=False)


def topic_options(assignments: list[str]) -> TopicOptions | None:
    """Return the topic options that ROLE=NAME assignments stand for; None if there are none.

    Raises:
        UsageError: a role is unknown, or its value does not fit.
    """
    changes: dict[str, Any] = {}
    for assignment in assignments:
        role, _, value = assignment.partition("=")
        if role not in TopicOptions.__slots__ or not value:
            roles = ", ".join(TopicOptions.__slots__)
            raise UsageError(f"--topic {assignment}: give ROLE=NAME with a role of {roles}")
        changes[role] = _like(getattr(TopicOptions(), role), value, assignment)
    return replace(TopicOptions(), **changes) if changes else None


def _like(known: object, value: str, assignment: str) -> object:
    if isinstance(known, bool):
        if value not in ("true", "false"):
            raise UsageError(f"--topic {assignment}: give true or false")
        return value == "true"
    if isinstance(known, int):
        if not value.isdecimal():
            raise UsageError(f"--topic {assignment}: give whole nanoseconds")
        return int(value)
    return value
