"""`canopy fit-wood`."""

from pathlib import Path
from typing import Annotated

import typer

from canopy_skel.errors import UsageError
from service.cli.shell import stderr
from service.kernels import compile_kernels

MASKS = ("recorded",)
"""The masks that the model sees wood beside: with worse ones it finds less beside good ones."""


def fit_wood(
    recordings: Annotated[
        list[Path], typer.Argument(metavar="REC...", help="Recordings with their true skeletons.")
    ],
    output: Annotated[Path, typer.Option("--output", "-o", help="The JSON file to write.")],
) -> None:
    """Refit what tells wood outside the masks from leaves to scans whose truth is known.

    The confidences are to be fitted again after it.
    """
    # Imported here: only this command fits.
    from canopy_skel.woodpixels import pixel_model_to
    from service.pixellessons import pixel_model_of

    if output.is_dir():
        raise UsageError(f"{output} is a folder; name the JSON file to write")
    compile_kernels(["canopy"])
    model = pixel_model_of(recordings, MASKS)
    if model is None:
        raise UsageError("no view has a depth image, stereo pairs only; add scans that have them")
    output.write_bytes(pixel_model_to(model))
    stderr.print(f"{output}: {model.provenance}", markup=False)
