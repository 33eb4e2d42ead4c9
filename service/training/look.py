"""A quick look at how a network is doing, taken every few minutes of training."""

from collections.abc import Sequence

import numpy as np
import torch

from canopy_skel.segmenters.unet.network import MULTIPLE_PX, Maps, UNet, maps_of, normalised
from canopy_skel.segmenters.unet.precision import has_fast_bfloat16
from canopy_skel.segmenters.unet.targets import ANGLE, ANGLE_STEPS, CENTRE, STATE, Target
from service.training.store import StoredImages


class Look:
    """Measures the maps, cell by cell, on some pictures of a set."""

    def __init__(self, images: StoredImages, numbers: Sequence[int]) -> None:
        """`numbers`: which pictures to look at."""
        self._images, self._numbers = images, numbers

    def __call__(self, network: UNet) -> dict[str, float]:
        """Return intersection over union of branch and middle line, and errors of direction."""
        totals, turns = np.zeros(4), [np.zeros(0)]
        for number in self._numbers:
            maps = np.array(self._images.maps(number))
            output = _run(network, np.array(self._images.color(number)))
            height, width = output.branch.shape[1:]
            counts, turn = _compared(output, maps[:height, :width])
            totals += counts
            turns.append(turn)
        apart = np.concatenate([*turns, [90.0] if totals[0] == 0 else []])
        return {
            "val_iou": float(totals[0] / max(totals[1], 1)),
            "val_centre_iou": float(totals[2] / max(totals[3], 1)),
            "val_angle_median": float(np.median(apart)),
            "val_angle_p90": float(np.percentile(apart, 90)),
        }


def _run(network: UNet, color: np.ndarray) -> Maps:
    height, width = (size // MULTIPLE_PX * MULTIPLE_PX for size in color.shape[:2])
    with (
        torch.inference_mode(),
        torch.autocast("cpu", torch.bfloat16, enabled=has_fast_bfloat16()),
    ):
        return maps_of(network(normalised(color[None, :height, :width])))


def _compared(output: Maps, maps: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return common and united cells of branch and centre, and angles apart in degrees."""
    judged = maps[..., STATE] != Target.IGNORE
    wood, middle = maps[..., STATE] == Target.BRANCH, maps[..., CENTRE] == 1
    found = (output.branch[0] > 0).numpy() & judged
    line = (output.centre[0] > 0).numpy() & judged
    counts = [found & wood, found | wood, line & middle, line | middle]
    angle = 0.5 * np.arctan2(output.sine[0].numpy(), output.cosine[0].numpy())
    true = maps[..., ANGLE] * (np.pi / ANGLE_STEPS)
    apart = np.abs(np.mod(angle - true + np.pi / 2, np.pi) - np.pi / 2)
    return np.array([c.sum() for c in counts], float), np.degrees(apart[found & wood])
