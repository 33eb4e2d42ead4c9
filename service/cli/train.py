"""`canopy train`."""

import json
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.progress import Progress, TaskID

from canopy_skel.errors import UsageError
from service.cli.labels import Branch, Coco, Images, LabelMe, Labels
from service.cli.shell import AsJson, Out, progress_bars, stderr
from service.outputs import require_writable

if TYPE_CHECKING:
    from service.training.user_pictures import UserPicture

RECIPES = ("builtin",)
NETWORKS = ("unet", "maskrcnn")
BUILTIN, NONE = "builtin", "none"

Facts = dict[str, Any]
Show = Callable[[str, int, int], None]


@dataclass(frozen=True, kw_only=True, slots=True)
class _Length:
    """How long to train; None = as the recipe says."""

    minutes: float | None
    steps: int | None

    def changes(self) -> dict[str, Any]:
        """Return what is to be changed in a plan."""
        given = {"minutes": self.minutes, "steps": self.steps}
        return {name: value for name, value in given.items() if value is not None}


def train(
    output: Out,
    recipe: Annotated[
        str | None, typer.Option(help=f"Synthetic pictures by recipe: {', '.join(RECIPES)}.")
    ] = None,
    coco: Coco = None,
    images: Images = None,
    labelme: LabelMe = None,
    branch: Branch = None,
    segmenter: Annotated[str, typer.Option(help=f"One of {', '.join(NETWORKS)}.")] = "unet",
    init: Annotated[
        str | None,
        typer.Option(help=f"Weights to go on from: {BUILTIN}, {NONE}, or a file (.pt)."),
    ] = None,
    minutes: Annotated[
        float | None, typer.Option(help="End training after so long; the learning rate follows.")
    ] = None,
    steps: Annotated[int | None, typer.Option(help="End training after so many batches.")] = None,
    scenes: Annotated[
        int | None, typer.Option(help="With --recipe: how many scenes of four pictures to draw.")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Train a segmenter on your labelled pictures, or anew on synthetic ones.

    OUTPUT gets the weights (unet.pt and unet.json, or maskrcnn.*), the pictures, checkpoints and
    the log; a broken-off run of unet is gone on with.
    """
    _require_amounts(minutes=minutes, steps=steps, scenes=scenes)
    if segmenter not in NETWORKS:
        raise UsageError(f"unknown segmenter {segmenter!r}: choose one of {', '.join(NETWORKS)}")
    length = _Length(minutes=minutes, steps=steps)
    weights = output / f"{segmenter}.pt"
    labels = Labels(coco=coco, images=images, labelme=labelme, branch=branch or ())
    if labels.source is None:
        if images is not None or branch or init is not None:
            raise UsageError("--images, --branch and --init go with labels: give --coco, --labelme")
        facts = _by_recipe(output, recipe or BUILTIN, segmenter, length, scenes)
    elif recipe is not None or scenes is not None:
        raise UsageError("give either labels (--coco, --labelme) or --recipe")
    else:
        facts = _on_labels(output, labels.pictures(), segmenter, init, length)
    if as_json:
        typer.echo(json.dumps(facts, indent=2))
        return
    typer.echo(f"{weights}: trained for {facts['training']['steps']} steps")
    typer.echo(f"  judged on: {facts['validation']['kind']}")
    for name, value in facts["validation"]["reported"].items():
        typer.echo(f"  {name:24} {'none' if value is None else f'{value:g}'}")


def _require_amounts(**amounts: float | None) -> None:
    for name, amount in amounts.items():
        if amount is not None and not amount > 0:
            raise UsageError(f"--{name} {amount}: give more than 0")


def _by_recipe(
    output: Path, recipe: str, segmenter: str, length: _Length, scenes: int | None
) -> Facts:
    # Imported here, as below: only this command needs torch and the simulation.
    from service.training.builtin import Amounts
    from service.training.recipe import BUILTIN_PLANS, builtin_weights, shortened

    if recipe not in RECIPES or segmenter != "unet":
        raise UsageError(
            f"unknown recipe {recipe!r} for {segmenter}: there is {', '.join(RECIPES)} for unet, or"
            " train on your own labels (--coco, --labelme)"
        )
    require_writable(output)
    amounts = Amounts()
    if scenes is not None:
        amounts = Amounts(train_scenes=scenes, validate_scenes=max(scenes // 10, 2))
    plans = shortened(BUILTIN_PLANS, length.steps, length.minutes)
    with progress_bars() as progress:
        return builtin_weights(output, output / "unet.pt", plans, amounts, _shown(progress))


def _on_labels(
    output: Path,
    pictures: "list[UserPicture]",
    segmenter: str,
    init: str | None,
    length: _Length,
) -> Facts:
    require_writable(output)
    make = _unet if segmenter == "unet" else _maskrcnn
    with progress_bars() as progress:
        warnings, facts = make(output, pictures, init, length, _shown(progress))
    for line in warnings:
        stderr.print(f"warning: {line}", style="yellow", markup=False)
    return facts


def _unet(
    output: Path, pictures: "list[UserPicture]", init: str | None, length: _Length, show: Show
) -> tuple[tuple[str, ...], Facts]:
    from canopy_skel.segmenters.unet import weights
    from service.training.user_recipe import FINE_PLAN, SCRATCH_PLAN, user_weights

    path = weights.BUILTIN if init in (None, BUILTIN) else Path(str(init))
    model = None if init == NONE else weights.load(path)
    plan = replace(SCRATCH_PLAN if model is None else FINE_PLAN, **length.changes())
    imported, facts = user_weights(output, output / "unet.pt", pictures, plan, model, show)
    return imported.warnings, facts


def _maskrcnn(
    output: Path, pictures: "list[UserPicture]", init: str | None, length: _Length, show: Show
) -> tuple[tuple[str, ...], Facts]:
    from service.training.maskrcnn import MaskRcnnPlan
    from service.training.maskrcnn_recipe import initial, maskrcnn_weights

    if init == BUILTIN:
        raise UsageError("there are no built-in weights of maskrcnn; give a checkpoint, or none")
    detector = initial(None if init in (None, NONE) else Path(str(init)))
    plan = replace(MaskRcnnPlan(), **length.changes())
    weights = output / "maskrcnn.pt"
    imported, facts = maskrcnn_weights(output, weights, pictures, plan, detector, show)
    return imported.warnings, facts


def _shown(progress: Progress) -> Show:
    tasks: dict[str, TaskID] = {}

    def show(name: str, done: int, total: int) -> None:
        kind = name.partition(" (")[0]
        if kind not in tasks:
            tasks[kind] = progress.add_task(name, total=total)
        progress.update(tasks[kind], description=name, completed=done, total=total)

    return show
