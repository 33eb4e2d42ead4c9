"""Weights on disk: a state dictionary in half precision beside a JSON that says what it is.

The JSON holds the file's SHA-256, which is compared before anything is unpickled.
"""

import hashlib
import io
import json
import pickle
from dataclasses import asdict, dataclass
from importlib.resources import files
from pathlib import Path
from typing import Any

import torch
from torch import nn
from torch.nn.utils.fusion import fuse_conv_bn_eval

from canopy_skel.errors import UsageError
from canopy_skel.segmenters.unet.features import FEATURES
from canopy_skel.segmenters.unet.grouping import Calibration, Grouping
from canopy_skel.segmenters.unet.network import UNet

FORMAT = "canopy-unet/1"
BUILTIN = Path(str(files(__package__) / "builtin.pt"))
_MOST_BYTES = 64 << 20


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
    state = {name: _narrowed(value) for name, value in model.network.state_dict().items()}
    buffer = io.BytesIO()
    torch.save(state, buffer)
    path.write_bytes(buffer.getvalue())
    description = {
        "format": FORMAT,
        "sha256": hashlib.sha256(buffer.getvalue()).hexdigest(),
        "channels": list(model.channels),
        "features": list(FEATURES),
        "grouping": asdict(model.grouping),
        "calibration": asdict(model.calibration),
        "least_score": model.least_score,
        **provenance,
    }
    path.with_suffix(".json").write_text(json.dumps(description, indent=2) + "\n")


def _narrowed(value: torch.Tensor) -> torch.Tensor:
    return value.detach().half() if value.is_floating_point() else value


def load(path: Path = BUILTIN) -> Model:
    """Read weights and check that they are whole, harmless and of this architecture.

    Raises:
        UsageError: they are not, or there are none.
    """
    description = _description(path)
    data = _checked(path, description["sha256"])
    try:
        state = torch.load(io.BytesIO(data), map_location="cpu", weights_only=True)
    except (pickle.UnpicklingError, RuntimeError, EOFError, ValueError) as error:
        raise UsageError(
            f"{path}: holds something other than plain weights and was not loaded; give a file"
            " that `canopy train` wrote"
        ) from error
    channels = tuple(description["channels"])
    network = UNet(channels)
    _require_fit(path, network, state)
    network.load_state_dict({name: value.float() for name, value in state.items()})
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


def _description(path: Path) -> dict[str, Any]:
    beside = path.with_suffix(".json")
    try:
        description = json.loads(beside.read_text())
    except OSError as error:
        raise UsageError(
            f"{beside}: cannot be read ({error.strerror}); weights come as two files, .pt and .json"
        ) from error
    except ValueError as error:
        raise UsageError(f"{beside}: is not JSON ({error}); copy both files anew") from error
    known = description.get("format") if isinstance(description, dict) else None
    if known != FORMAT or description.get("features") != list(FEATURES):
        raise UsageError(
            f"{path}: is of format {known!r}, this version reads {FORMAT!r} with its own features;"
            " train anew, or use the version that wrote it"
        )
    missing = {"sha256", "channels", "grouping", "calibration", "least_score"} - description.keys()
    if missing:
        raise UsageError(f"{beside}: lacks {', '.join(sorted(missing))}; copy both files anew")
    known_good: dict[str, Any] = description
    return known_good


def _checked(path: Path, sha256: str) -> bytes:
    try:
        if path.stat().st_size > _MOST_BYTES:
            raise UsageError(f"{path}: is larger than {_MOST_BYTES >> 20} MiB; not our weights")
        data = path.read_bytes()
    except OSError as error:
        raise UsageError(f"{path}: cannot be read ({error.strerror}); check the path") from error
    found = hashlib.sha256(data).hexdigest()
    if found != sha256:
        raise UsageError(
            f"{path}: is not the file its JSON describes (SHA-256 {found[:12]}…, expected"
            f" {sha256[:12]}…), truncated or changed; copy both files anew"
        )
    return data


def _require_fit(path: Path, network: UNet, state: object) -> None:
    """Refuse weights of another architecture, naming the first difference."""
    wanted = {name: tuple(value.shape) for name, value in network.state_dict().items()}
    given = (
        {name: tuple(getattr(value, "shape", ())) for name, value in state.items()}
        if isinstance(state, dict)
        else {}
    )
    for name in sorted(wanted.keys() | given.keys(), key=str):
        if wanted.get(name) != given.get(name):
            raise UsageError(
                f"{path}: is of another architecture: {name} is {given.get(name, 'missing')},"
                f" expected {wanted.get(name, 'nothing')}; give weights of the unet segmenter"
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
