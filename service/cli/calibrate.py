"""`canopy calibrate`."""

import json
from pathlib import Path
from typing import Annotated

import cv2
import typer

from canopy_skel.errors import UsageError
from drivers.board import Board, drawn
from service.calibration import calibrate_recording, described, facts_of
from service.cli.shell import AsJson, Exit, topic_options
from service.outputs import require_writable, write_all

_DRAWN_SQUARE_M, _DRAWN_MARKER_SHARE = 0.030, 0.022 / 0.030


def calibrate(
    recording: Annotated[
        Path | None, typer.Argument(help="A scan of the board, 15 views or more.")
    ] = None,
    squares: Annotated[str, typer.Option(help="Squares of the board, COLUMNSxROWS.")] = "9x6",
    square: Annotated[
        float | None,
        typer.Option(help="Side of a square in metres, measured: across the board, divided."),
    ] = None,
    marker: Annotated[
        float | None, typer.Option(help="Side of a marker in metres; as --draw draws them.")
    ] = None,
    dictionary: Annotated[str, typer.Option(help="Of the markers.")] = "5X5_100",
    draw: Annotated[
        Path | None, typer.Option(help="Draw the board into this PNG, to print it, and end.")
    ] = None,
    topic: list[str] | None = None,
    as_json: AsJson = False,
) -> None:
    """Find where the camera sits on the flange, from a scan of a ChArUco board at rest."""
    columns, _, rows = squares.partition("x")
    if not (columns.isdecimal() and rows.isdecimal()):
        raise UsageError(f"--squares {squares}: give COLUMNSxROWS, such as 9x6")
    if square is None:
        if recording is not None and draw is None:  # printers scale: a default would go unnoticed
            raise UsageError(
                "say with --square how long the side of a square is, in metres: measure across"
                " the whole board as printed and divide"
            )
        square = _DRAWN_SQUARE_M
    board = Board(
        columns=int(columns),
        rows=int(rows),
        square_m=square,
        marker_m=square * _DRAWN_MARKER_SHARE if marker is None else marker,
        dictionary=dictionary,
    )
    if recording is None and draw is not None:
        require_writable(draw.parent)
        write_all(draw.parent, {draw.name: cv2.imencode(".png", drawn(board))[1].tobytes()})
        return
    if recording is None or draw is not None:
        raise UsageError("give either a recording of the board, or --draw and a file for it")
    result = calibrate_recording(recording, board, topic_options(topic or []))
    typer.echo(json.dumps(facts_of(result), indent=2) if as_json else described(result))
    if not result.accepted:
        raise typer.Exit(Exit.FAILED)
