"""`canopy train`."""

import json
from dataclasses import replace
from typing import Annotated

import typer
from rich.progress import TaskID

from canopy_skel.errors import UsageError
from service.cli.shell import AsJson, Out, progress_bars
from service.outputs import require_writable

RECIPES = ("builtin",)


def train(
    output: Out,
    recipe: Annotated[str, typer.Option(help=f"One of {', '.join(RECIPES)}.")] = "builtin",
    minutes: Annotated[
        float | None, typer.Option(help="End training after so long; the learning rate follows.")
    ] = None,
    steps: Annotated[int | None, typer.Option(help="End training after so many batches.")] = None,
    scenes: Annotated[
        int | None, typer.Option(help="How many scenes of four pictures to draw for training.")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Train the learned segmenter on synthetic pictures; a broken-off run is gone on with.

    OUTPUT gets the weights (unet.pt and unet.json), the pictures, checkpoints and the log.
    """
    # Imported here: only this command needs torch and the simulation.
    from service.training.builtin import Amounts
    from service.training.recipe import BUILTIN_PLAN, builtin_weights

    if recipe not in RECIPES:
        raise UsageError(f"unknown recipe {recipe!r}: choose one of {', '.join(RECIPES)}")
    require_writable(output)
    plan, amounts = BUILTIN_PLAN, Amounts()
    if minutes is not None:
        plan = replace(plan, minutes=minutes)
    if steps is not None:
        plan = replace(plan, steps=steps)
    if scenes is not None:
        amounts = Amounts(train_scenes=scenes, validate_scenes=max(scenes // 10, 2))
    with progress_bars() as progress:
        tasks: dict[str, TaskID] = {}

        def show(name: str, done: int, total: int) -> None:
            if name not in tasks:
                tasks[name] = progress.add_task(name, total=total)
            progress.update(tasks[name], completed=done, total=total)

        facts = builtin_weights(output, output / "unet.pt", plan, amounts, show)
    if as_json:
        typer.echo(json.dumps(facts, indent=2))
        return
    typer.echo(f"{output / 'unet.pt'}: trained for {facts['training']['steps']} steps")
    for name, value in facts["validation"]["reported"].items():
        typer.echo(f"  {name:24} {value:g}")
