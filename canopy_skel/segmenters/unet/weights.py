"""Weights on disk: a state dictionary in half precision beside a JSON that says what it is.

The JSON holds the file's SHA-256, which is compared before anything is unpickled.
"""

import operator
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
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
_MOST_CHANNELS = 4096
UNCALIBRATED = Calibration(weights=tuple(4.0 * (name == "branch") for name in FEATURES), bias=-2.0)
"""Scores for a network nobody has calibrated."""
_NEEDED = frozenset({"channels", "features", "grouping", "calibration", "least_score"})


@dataclass(frozen=True, kw_only=True, eq=False, slots=True)
class Model:
    """A trained network and how its maps become instances.

    zoom: how much enlarged it sees pictures. least_score: instances below are not reported.
    """

    network: UNet
    channels: tuple[int, ...]
    zoom: float
    grouping: Grouping
    calibration: Calibration
    least_score: float


def save(path: Path, model: Model, provenance: dict[str, Any]) -> None:
    """Write weights as float16, and the JSON beside them."""
    description = {
        "format": FORMAT,
        "channels": list(model.channels),
        "zoom": model.zoom,
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
    channels, zoom, grouping, calibration, least_score = _settings(path, description)
    network = UNet(channels)
    state = read_state(path, description["sha256"], _MOST_BYTES)
    require_fit(path, network.state_dict(), state)
    network.load_state_dict(state)
    return Model(
        network=network.eval(),
        channels=channels,
        zoom=zoom,
        grouping=grouping,
        calibration=calibration,
        least_score=least_score,
    )


def _settings(
    path: Path, description: Mapping[str, Any]
) -> tuple[tuple[int, ...], float, Grouping, Calibration, float]:
    """Return channels, zoom, grouping, calibration and least score that a description holds.

    Raises:
        UsageError: it holds something else.
    """
    try:
        channels = tuple(map(operator.index, description["channels"]))
        given = description["calibration"]
        calibration = Calibration(weights=tuple(map(float, given["weights"])), bias=given["bias"])
        least_score = float(description["least_score"])
        zoom = float(description.get("zoom", 1.0))
        if len(channels) < 2 or not 0 < min(channels) <= max(channels) <= _MOST_CHANNELS:
            raise ValueError(f"{channels} are no channels")
        if len(calibration.weights) != len(FEATURES):
            raise ValueError(f"{len(calibration.weights)} weights for {len(FEATURES)} features")
        grouping = Grouping(**description["grouping"])
        numbers = [*asdict(grouping).values(), *calibration.weights, calibration.bias]
        if not np.isfinite(numbers).all():
            raise ValueError("not all numbers are finite")
        if not 0.1 <= zoom <= 10:
            raise ValueError(f"zoom is {zoom}, not from 0.1 to 10")
        if not 0 <= least_score <= 1:
            raise ValueError(f"least_score is {least_score}, not from 0 to 1")
        return channels, zoom, grouping, calibration, least_score
    except (KeyError, TypeError, ValueError) as error:
        raise UsageError(
            f"{path.with_suffix('.json')}: does not say how the network is used ({error}); copy"
            " both files anew"
        ) from error


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
