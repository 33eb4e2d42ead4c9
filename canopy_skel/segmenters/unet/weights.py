"""Weights on disk: a state dictionary in half precision beside a JSON that says what it is.

The JSON holds the file's SHA-256, which is compared before anything is unpickled.
"""

from dataclasses import asdict, dataclass
from importlib.resources import files
from pathlib import Path
from typing import Any

from torch import nn
from torch.nn.utils.fusion import fuse_conv_bn_eval

from canopy_skel.errors import UsageError
from canopy_skel.segmenters.unet.features import FEATURES
from canopy_skel.segmenters.unet.grouping import Calibration, Grouping
from canopy_skel.segmenters.unet.network import UNet
from canopy_skel.segmenters.weight_files import (
    read_description,
    read_state,
    require_fit,
    write_weights,
)

FORMAT = "canopy-unet/1"
BUILTIN = Path(str(files(__package__) / "builtin.pt"))
_MOST_BYTES = 64 << 20
_NEEDED = frozenset({"channels", "features", "grouping", "calibration", "least_score"})


@dataclass(frozen=True, kw_only=True, eq=False, slots=True)
class Model:
    """A trained network and how its maps become instances.

    least_score: instances below are not reported.
    """

    network: UNet
    channels: tuple[int, ...]
    grouping: Grouping
    calibration: Calibration
    least_score: float


def save(path: Path, model: Model, provenance: dict[str, Any]) -> None:
    """Write weights as float16, and the JSON beside them."""
    description = {
        "format": FORMAT,
        "channels": list(model.channels),
        "features": list(FEATURES),
        "grouping": asdict(model.grouping),
        "calibration": asdict(model.calibration),
        "least_score": model.least_score,
        **provenance,
    }
    write_weights(path, model.network.state_dict(), description)


def load(path: Path = BUILTIN) -> Model:
    """Read weights and check that they are whole, harmless and of this architecture.

    Raises:
        UsageError: they are not, or there are none.
    """
    description = read_description(path, FORMAT, _NEEDED)
    if description["features"] != list(FEATURES):
        raise UsageError(
            f"{path}: its scores rest on other features than this version's; train anew, or use the"
            " version that wrote it"
        )
    channels = tuple(description["channels"])
    network = UNet(channels)
    state = read_state(path, description["sha256"], _MOST_BYTES)
    require_fit(path, network.state_dict(), state)
    network.load_state_dict(state)
    return Model(
        network=network.eval(),
        channels=channels,
        grouping=Grouping(**description["grouping"]),
        calibration=Calibration(
            weights=tuple(description["calibration"]["weights"]),
            bias=description["calibration"]["bias"],
        ),
        least_score=description["least_score"],
    )


def fused(network: UNet) -> UNet:
    """Fold batch normalisation into the convolutions before it, in place; for inference only."""
    for module in list(network.modules()):
        if not isinstance(module, nn.Sequential):
            continue
        convolution, normalisation = module[0], module[1]
        if isinstance(convolution, nn.Conv2d) and isinstance(normalisation, nn.BatchNorm2d):
            module[0] = fuse_conv_bn_eval(convolution, normalisation)
            module[1] = nn.Identity()
    return network
