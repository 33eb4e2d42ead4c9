"""`canopy fit-confidence`."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from canopy_skel.errors import UsageError
from service.cli.shell import progress_bars, stderr
from service.kernels import compile_kernels

if TYPE_CHECKING:
    from canopy_skel.confidence import ModelSets

WORSE_MASKS = ("drop25+false20", "unet")
"""What the shipped confidences of learned masks are fitted to, beside recorded ones."""


def fit_confidence(
    recordings: Annotated[
        list[Path], typer.Argument(metavar="REC...", help="Recordings with their true skeletons.")
    ],
    output: Annotated[Path, typer.Option("--output", "-o", help="The JSON file to write.")],
    held_out: Annotated[
        list[Path] | None,
        typer.Option(help="Recordings to test on, not fitted; repeatable."),
    ] = None,
    pixels: Annotated[
        list[Path] | None,
        typer.Option(
            help="More recordings of trees that fit-wood was given, to learn wood pixels from"
            " meanwhile; repeatable."
        ),
    ] = None,
    segmenter: Annotated[
        list[str] | None,
        typer.Option(
            help="Masks that learned ones may be like; repeatable."
            f" Without: {', '.join(WORSE_MASKS)}, as shipped."
        ),
    ] = None,
) -> None:
    """Refit the confidences of method canopy to scans whose truth is known.

    Those for recorded masks are fitted to recorded masks, with and without fragments; those for
    learned masks to these and the ones of all other segmenters. Of trees that the shipped model of
    wood pixels was fitted to (fit-wood), each half gets one that is fitted to the other half.
    """
    # Imported here: only this command fits.
    from canopy_skel.confidence import models_to
    from service.lessons import fitted, lessons_from, pixel_models_without

    if output.is_dir():
        raise UsageError(f"{output} is a folder; name the JSON file to write")
    masks = ("recorded", *(segmenter or WORSE_MASKS))
    compile_kernels(["canopy", *masks])
    pixel_models = pixel_models_without(recordings, pixels or ())
    lessons = []
    with progress_bars() as progress:
        task = progress.add_task("scans", total=len(recordings))
        for path in sorted(recordings):
            lessons.append(lessons_from(path, masks, pixel_models[path]))
            progress.advance(task)
    models = fitted(lessons, [path.stem for path in sorted(recordings)], masks)
    output.write_bytes(models_to(models))
    for kind, by_depth in models.items():
        for depth, one in by_depth.items():
            stderr.print(f"{output}, {kind}, {depth}: {one.provenance}", markup=False)
    _show_held_out(held_out or (), masks, models)


def _show_held_out(paths: Sequence[Path], masks: Sequence[str], models: "ModelSets") -> None:
    from canopy_skel.fitting import reliability
    from service.lessons import lesson_from

    for path in paths:
        for name in masks:
            lesson = lesson_from(path, name)
            chosen = models["recorded" if name == "recorded" else "learned"][lesson.depth]
            row = reliability(lesson, chosen)
            figures = " ".join(f"{model} {value:.3f}" for model, value in row.items())
            typer.echo(f"{path.stem}, {name}: {figures}")
