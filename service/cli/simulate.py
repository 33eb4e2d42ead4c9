"""`canopy simulate`."""

import json
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from canopy_skel.errors import UsageError
from service.cli.shell import WIDEST_RANGE, AsJson, Exit, Out, progress_bars, stderr
from service.outputs import require_writable
from service.skeletons import SOFTWARE

if TYPE_CHECKING:
    from mock_hw.orchard.dataset import Recorded


def simulate(
    output: Out,
    species: Annotated[str, typer.Option(help="Of apple,oak,walnut.")] = "apple,oak,walnut",
    topologies: Annotated[
        str, typer.Option(help="How many trees of each (10), or which (0-9 or 0,4,7-9).")
    ] = "1",
    foliage: Annotated[str, typer.Option(help="Foliage densities, of 1-4.")] = "1-4",
    views: Annotated[int, typer.Option(help="Views of each tree: 10 or 70.")] = 10,
    noise: Annotated[str, typer.Option(help="Of the poses: none, nominal or bad.")] = "nominal",
    stereo: Annotated[
        bool, typer.Option("--stereo", help="Record stereo pairs instead of depth images.")
    ] = False,
    wind: Annotated[float, typer.Option(help="Metres that the loosest tip moves.")] = 0.0,
    weather: Annotated[str, typer.Option(help="any (drawn for each tree) or fair.")] = "any",
    seed: Annotated[int, typer.Option(help="Of noise, light and wind.")] = 0,
    jobs: Annotated[int, typer.Option(help="How many processes.")] = 1,
    picture_scale: Annotated[float, typer.Option(help="Size of the pictures.")] = 1.0,
    check: Annotated[
        bool, typer.Option("--check", help="Make nothing; check what the manifest lists.")
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Simulate scans of orchard trees: recordings with the true skeletons, and a manifest.

    Run again after an interruption, it goes on where it stopped.
    """
    # Imported here: only this command simulates, and what draws takes long to load.
    from mock_hw.orchard.dataset import Settings, leafy_trees
    from mock_hw.orchard.production import produce

    if check:
        _check(output, as_json=as_json)
        return
    wanted = leafy_trees(
        _names(species),
        _topologies(topologies),
        _numbers("--foliage", foliage),
    )
    settings = Settings(
        views=views,
        noise=noise,
        stereo=stereo,
        wind_m=wind,
        weather=weather,
        seed=seed,
        picture_scale=picture_scale,
    )
    require_writable(output)
    made = []
    with progress_bars() as progress:
        task = progress.add_task("recordings", total=len(wanted))
        for one in produce(output, wanted, settings, software=SOFTWARE, jobs=jobs):
            progress.advance(task)
            made.append(one)
            word = "made" if one.made else "there already"
            stderr.print(
                f"{len(made)}/{len(wanted)} {one.recorded.file} {word}: {one.recorded.leaf_count}"
                f" leaves, V_det {one.recorded.v_det:.3f} ({one.recorded.v_det_target:.2f})"
            )
    _report(output, [one.recorded for one in made], as_json=as_json)


def _check(folder: Path, *, as_json: bool) -> None:
    """Compare the recordings of a folder with its manifest."""
    from mock_hw.orchard.dataset import flaw_of, read_manifest, recorded_in

    recordings = recorded_in(read_manifest(folder))
    flaws = [flaw for one in recordings if (flaw := flaw_of(folder, one)) is not None]
    for flaw in flaws:
        stderr.print(f"error: {flaw}; run canopy simulate again", style="red", markup=False)
    _report(folder, recordings, as_json=as_json)
    if flaws:
        raise typer.Exit(Exit.FAILED)


def _report(folder: Path, recordings: "list[Recorded]", *, as_json: bool) -> None:
    from mock_hw.orchard.census import ALLOWED_MISS, as_table, density_rows
    from mock_hw.orchard.dataset import MANIFEST

    rows = density_rows(recordings)
    if as_json:
        result = {
            "manifest": str(folder / MANIFEST),
            "recordings": [asdict(one) for one in recordings],
            "densities": [asdict(row) for row in rows],
        }
        typer.echo(json.dumps(result, indent=2))
    else:
        typer.echo(as_table(rows))
    for row in rows:
        if row.worst_miss > ALLOWED_MISS:
            stderr.print(
                f"warning: V_det of {row.worst_file} is {row.worst_miss:.3f} off its target",
                style="yellow",
                markup=False,
            )


def _names(text: str) -> list[str]:
    return list(dict.fromkeys(text.split(",")))


def _topologies(text: str) -> list[int]:
    """Return 0…N-1 for a single number N, else the numbers of a list of ranges."""
    if not text.isdecimal():
        return _numbers("--topologies", text)
    if int(text) < 1:
        raise UsageError(f"--topologies {text}: give 1 or more trees")
    return _numbers("--topologies", f"0-{int(text) - 1}")


def _numbers(option: str, text: str) -> list[int]:
    """Return the numbers of a list like 0,4,7-9, in order and each once."""
    numbers: dict[int, None] = {}
    for part in text.split(","):
        first, dash, last = part.partition("-")
        if not (first.isdecimal() and (last.isdecimal() or not dash)):
            raise UsageError(f"{option} {text}: give numbers and ranges, as in 0-9 or 0,4,7-9")
        ends = int(first), int(last) if dash else int(first)
        if not 0 <= ends[1] - ends[0] < WIDEST_RANGE:
            raise UsageError(f"{option} {text}: {part} is no range; give the smaller number first")
        numbers.update(dict.fromkeys(range(ends[0], ends[1] + 1)))
    return list(numbers)
