"""`canopy fit-confidence`."""

from pathlib import Path
from typing import Annotated

import typer

from canopy_skel.errors import UsageError
from service.cli.shell import progress_bars, stderr


def fit_confidence(
    recordings: Annotated[
        list[Path], typer.Argument(metavar="REC...", help="Recordings with their true skeletons.")
    ],
    output: Annotated[Path, typer.Option("--output", "-o", help="The JSON file to write.")],
    held_out: Annotated[
        list[Path] | None,
        typer.Option(help="Recordings to test on, not fitted; repeatable."),
    ] = None,
    segmenter: Annotated[str, typer.Option(help="Where branch masks come from.")] = "recorded",
) -> None:
    """Refit the confidences of method canopy to scans whose truth is known."""
    # Imported here: only this command fits.
    from canopy_skel.confidence import models_to
    from canopy_skel.fitting import fit_models, reliability
    from canopy_skel.pipeline import MethodConfig
    from service.lessons import lesson_from

    if output.is_dir():
        raise UsageError(f"{output} is a folder; name the JSON file to write")
    lessons = []
    with progress_bars() as progress:
        task = progress.add_task("scans", total=len(recordings))
        for path in recordings:
            lessons.append(lesson_from(path, segmenter))
            progress.advance(task)
    names = ", ".join(sorted(path.stem for path in recordings))
    settings = MethodConfig(name="canopy").sha256()[:12]
    models = fit_models(
        lessons,
        f"fitted to {len(lessons)} scans ({segmenter} masks, settings {settings}): {names}",
    )
    output.write_bytes(models_to(models))
    stderr.print(f"{output}: {models.provenance}", markup=False)
    for path in held_out or []:
        row = reliability(lesson_from(path, segmenter), models)
        figures = " ".join(f"{name} {value:.3f}" for name, value in row.items())
        typer.echo(f"{path.stem}: {figures}")
