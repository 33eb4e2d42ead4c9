"""The network for runtimes that do not have torch: ONNX, pictures in, the eight maps out."""

import gzip
import io
import warnings
from importlib.util import find_spec
from pathlib import Path

import torch
from torch import Tensor, nn

from canopy_skel.errors import UsageError
from canopy_skel.segmenters.unet.network import UNet, scaled
from canopy_skel.segmenters.unet.tiles import MULTIPLE_PX
from canopy_skel.segmenters.unet.weights import Model

OPSET = 17
INPUT, OUTPUT = "pictures_rgb", "maps"


class _Whole(nn.Module):
    """The network with the scaling of pictures before it."""

    def __init__(self, network: UNet) -> None:
        super().__init__()
        self.network = network

    def forward(self, pictures_rgb: Tensor) -> Tensor:
        result: Tensor = self.network(scaled(pictures_rgb))
        return result


def export_onnx(model: Model, path: Path) -> None:
    """Write the network as ONNX, opset 17, batch, height and width free; packed if named .gz.

    Input `pictures_rgb`: (N, 3, H, W) float32, 0 to 255, H and W multiples of 32 (continue the
    edge), enlarged as `Model.zoom` says. Output `maps`: (N, 8, H / 2, W / 2), see `network.Maps`;
    what groups them into instances is not part of it. Normalisations are left as they are, for the
    runtime to fold in: so the weights keep to what half precision holds, and pack well.

    Raises:
        UsageError: the package onnx is not installed, or the file cannot be written.
    """
    if find_spec("onnx") is None:  # Asked here: torch says so by an error of its own kind.
        raise UsageError("ONNX needs the extra `onnx`: pip install 'canopy-skel[onnx]'")
    network = _Whole(_copied(model))
    buffer = io.BytesIO()
    example = torch.zeros(1, 3, 2 * MULTIPLE_PX, 2 * MULTIPLE_PX)
    free = {0: "count", 2: "height", 3: "width"}
    try:
        with warnings.catch_warnings():
            # The exporter without further packages is the older one, and says so.
            warnings.simplefilter("ignore")
            torch.onnx.export(
                network,
                (example,),
                buffer,  # type: ignore[arg-type]  # files too, unlike what is declared
                input_names=[INPUT],
                output_names=[OUTPUT],
                dynamic_axes={INPUT: free, OUTPUT: free},
                opset_version=OPSET,
                training=torch.onnx.TrainingMode.PRESERVE,
                dynamo=False,
            )
        whole = buffer.getvalue()
        path.write_bytes(gzip.compress(whole, mtime=0) if path.suffix == ".gz" else whole)
    except OSError as error:
        raise UsageError(
            f"{path}: cannot be written ({error.strerror}); check the folder"
        ) from error


def _copied(model: Model) -> UNet:
    network = UNet(model.channels)
    network.load_state_dict(model.network.state_dict())
    return network.eval()
