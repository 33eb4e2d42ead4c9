"""`canopy coco`."""

import json
from typing import Annotated

import typer

from service.cli.shell import AsJson, Out, progress_bars
from service.outputs import require_writable
from service.skeletons import SOFTWARE


def coco(
    output: Out,
    images: Annotated[int, typer.Option(help="How many.")] = 100,
    species: Annotated[str, typer.Option(help="Of apple,oak,walnut.")] = "apple,oak,walnut",
    seed: Annotated[int, typer.Option(help="Of trees, leaves, light and camera.")] = 0,
    jobs: Annotated[int, typer.Option(help="How many processes.")] = 1,
    picture_scale: Annotated[float, typer.Option(help="Size of the pictures.")] = 1.0,
    as_json: AsJson = False,
) -> None:
    """Write training images of simulated trees, with branch labels, as a COCO data set.

    Run again, it goes on where it stopped; with more --images, it adds to what is there.
    """
    # Imported here: only simulation draws, and what draws takes long to load.
    from mock_hw.orchard.coco import ANNOTATIONS, TrainingSet, export_coco

    require_writable(output)
    wanted = TrainingSet(
        seed=seed,
        species=tuple(dict.fromkeys(species.split(","))),
        picture_scale=picture_scale,
        software=SOFTWARE,
    )
    with progress_bars() as progress:
        task = progress.add_task("images", total=images)
        for done in export_coco(output, images, wanted, jobs=jobs):
            progress.update(task, completed=done)
    path = output / ANNOTATIONS
    typer.echo(json.dumps({"annotations": str(path), "images": images}) if as_json else path)
