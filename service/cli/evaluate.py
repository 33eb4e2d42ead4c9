"""What `canopy segment --evaluate` prints."""

import typer

from service.evaluation import Evaluation


def print_evaluation(result: Evaluation) -> None:
    """Print the figures of one source; docs/segmentation.md says what they mean."""
    typer.echo(result.source)
    figures = result.scores.to_dict()
    width = max(map(len, figures))
    for name, value in figures.items():
        typer.echo(f"  {name:{width}}  {_shown(value)}")
    pace = result.pace
    typer.echo(
        f"  {pace.wall_ms:.0f} ms per picture of {pace.size_px[0]}x{pace.size_px[1]}"
        f" ({pace.cpu_ms:.0f} ms of processor time) on {pace.cpu}"
    )
    if result.skeleton:
        names = list(result.skeleton)
        typer.echo("  skeleton" + "".join(f"{name:>12}" for name in names))
        for figure in result.skeleton[names[0]]:
            row = "".join(f"{_shown(result.skeleton[name][figure]):>12}" for name in names)
            typer.echo(f"    {figure:{width}}{row}")


def _shown(value: float | int | None) -> str:
    if value is None:
        return "-"
    return f"{value:.3f}" if isinstance(value, float) else str(value)
