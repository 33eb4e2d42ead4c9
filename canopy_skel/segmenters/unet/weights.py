"""Weights on disk: a state dictionary in half precision beside a JSON that says what it is.

The JSON holds the file's SHA-256, which is compared before anything is unpickled.
"""

import operator
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
from torch import Tensor, nn
from torch.nn.utils.fusion import fuse_conv_bn_eval

from canopy_skel.errors import UsageError
from canopy_skel.segmenters.unet.grouping import Grouping
from canopy_skel.segmenters.unet.network import Maps, UNet
from canopy_skel.segmenters.unet.scorer import Scorer
from canopy_skel.segmenters.weight_files import (
    read_description,
    read_state,
    require_fit,
    write_weights,
)

FORMAT = "canopy-unet/2"
BUILTIN = Path(str(files(__package__) / "builtin.pt"))
_MOST_BYTES = 64 << 20
_MOST_CHANNELS = 4096
_NEEDED = frozenset({"channels", "grouping", "least_score"})
_SCORER = "scorer."
"""Before the names of the scorer's tensors; the network's have none."""


@dataclass(frozen=True, kw_only=True, eq=False, slots=True)
class Model:
    """A trained network and how its maps become instances.

    zoom: how much enlarged it sees pictures. least_score: instances below are not reported.
    """

    network: UNet
    channels: tuple[int, ...]
    zoom: float
    grouping: Grouping
    scorer: Scorer
    least_score: float


def save(path: Path, model: Model, provenance: dict[str, Any]) -> None:
    """Write weights as float16, and the JSON beside them."""
    description = {
        "format": FORMAT,
        "channels": list(model.channels),
        "zoom": model.zoom,
        "grouping": asdict(model.grouping),
        "least_score": model.least_score,
        **provenance,
    }
    write_weights(path, _state_of(model.network, model.scorer), description)


def load(path: Path = BUILTIN) -> Model:
    """Read weights and check that they are whole, harmless and of this architecture.

    Raises:
        UsageError: they are not, or there are none.
    """
    description = read_description(path, FORMAT, _NEEDED)
    channels, zoom, grouping, least_score = _settings(path, description)
    network, scorer = UNet(channels), untaught_scorer(channels)
    state = read_state(path, description["sha256"], _MOST_BYTES)
    require_fit(path, _state_of(network, scorer), state)
    own = {name for name in state if name.startswith(_SCORER)}
    network.load_state_dict({name: state[name] for name in state.keys() - own})
    scorer.load_state_dict({name.removeprefix(_SCORER): state[name] for name in own})
    return Model(
        network=network.eval(),
        channels=channels,
        zoom=zoom,
        grouping=grouping,
        scorer=scorer.eval(),
        least_score=least_score,
    )


def untaught_scorer(channels: Sequence[int]) -> Scorer:
    """Return a scorer with random weights for a network of such channels."""
    return Scorer(len(Maps._fields) + channels[0])


def _state_of(network: UNet, scorer: Scorer) -> dict[str, Tensor]:
    own = {_SCORER + name: value for name, value in scorer.state_dict().items()}
    return network.state_dict() | own


def _settings(
    path: Path, description: Mapping[str, Any]
) -> tuple[tuple[int, ...], float, Grouping, float]:
    """Return channels, zoom, grouping and least score that a description holds.

    Raises:
        UsageError: it holds something else.
    """
    try:
        channels = tuple(map(operator.index, description["channels"]))
        least_score = float(description["least_score"])
        zoom = float(description.get("zoom", 1.0))
        if len(channels) < 2 or not 0 < min(channels) <= max(channels) <= _MOST_CHANNELS:
            raise ValueError(f"{channels} are no channels")
        given = dict(description["grouping"])
        centres = tuple(map(float, given.pop("centres")))
        grouping = Grouping(centres=centres, **given)
        if not np.isfinite([*centres, *given.values()]).all():
            raise ValueError("not all numbers are finite")
        if not centres or not all(0 < centre < 1 for centre in centres):
            raise ValueError(f"centres are {list(centres)}, not some between 0 and 1")
        if not 0 <= grouping.taken < 1:
            raise ValueError(f"taken is {grouping.taken}, not from 0 to below 1")
        if not 0.1 <= zoom <= 10:
            raise ValueError(f"zoom is {zoom}, not from 0.1 to 10")
        if not 0 <= least_score <= 1:
            raise ValueError(f"least_score is {least_score}, not from 0 to 1")
        return channels, zoom, grouping, least_score
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
