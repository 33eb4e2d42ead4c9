"""`canopy export-onnx`."""

from pathlib import Path
from typing import Annotated

import typer


def export_onnx(
    output: Annotated[Path, typer.Argument(help="The ONNX file to write.")],
    weights: Annotated[
        Path | None, typer.Option(help="Weights of unet (.pt); the built-in ones if none.")
    ] = None,
) -> None:
    """Write the network of the unet segmenter as ONNX, for runtimes without torch."""
    # Imported here: only this command needs them.
    from canopy_skel.segmenters.unet import onnx_export
    from canopy_skel.segmenters.unet.weights import BUILTIN, load

    onnx_export.export_onnx(load(BUILTIN if weights is None else weights), output)
    typer.echo(f"{output}: {output.stat().st_size / 1e6:.1f} MB, opset {onnx_export.OPSET}")
