"""A trained Mask R-CNN on disk."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from canopy_skel.errors import UsageError
from canopy_skel.segmenters.maskrcnn.network import MOST_BYTES, SIZE_PX, Norm, build
from canopy_skel.segmenters.weight_files import (
    read_description,
    read_state,
    require_fit,
    write_weights,
)

if TYPE_CHECKING:
    from torchvision.models.detection import MaskRCNN

FORMAT = "canopy-maskrcnn/1"
LEAST_SCORE = 0.9
"""The authors' `SCORE_THRESH_TEST`."""


@dataclass(frozen=True, kw_only=True, eq=False, slots=True)
class Detector:
    """A trained network: see `network.build`. least_score: instances below are not reported."""

    network: "MaskRCNN"
    norm: Norm
    size_px: tuple[int, int] = SIZE_PX
    least_score: float = LEAST_SCORE


def save(path: Path, detector: Detector, provenance: dict[str, Any]) -> None:
    """Write weights as float16, and the JSON beside them."""
    description = {
        "format": FORMAT,
        "norm": detector.norm,
        "size_px": list(detector.size_px),
        "least_score": detector.least_score,
        **provenance,
    }
    write_weights(path, detector.network.state_dict(), description)


def load(path: Path) -> Detector:
    """Read weights and check that they are whole, harmless and of this architecture.

    Raises:
        UsageError: they are not, there are none, or torchvision is not installed.
    """
    description = read_description(path, FORMAT, frozenset({"norm", "size_px", "least_score"}))
    norm, size_px = description["norm"], tuple(description["size_px"])
    if norm not in ("group", "frozen_batch") or len(size_px) != 2:
        raise UsageError(f"{path}: its JSON says norm {norm!r}, size {size_px}; copy both anew")
    network = build(norm, (size_px[0], size_px[1]))
    state = read_state(path, description["sha256"], MOST_BYTES)
    require_fit(path, network.state_dict(), state)
    network.load_state_dict(state)
    return Detector(
        network=network.eval(),
        norm=norm,
        size_px=(size_px[0], size_px[1]),
        least_score=description["least_score"],
    )
