"""A quick look at how a network is doing, taken every few minutes of training."""

from collections.abc import Sequence

import cv2
import numpy as np

from canopy_skel.frame import Float32Array
from canopy_skel.segmenters.unet.grouping import Grouping
from canopy_skel.segmenters.unet.network import UNet
from canopy_skel.segmenters.unet.precision import has_fast_bfloat16
from canopy_skel.segmenters.unet.segmenter import UNetSegmenter
from canopy_skel.segmenters.unet.targets import ANGLE, ANGLE_STEPS, CENTRE, STATE, Target
from canopy_skel.segmenters.unet.weights import UNCALIBRATED, Model
from service.training.store import StoredImages


class Look:
    """Measures the maps, cell by cell, on some pictures of a set."""

    def __init__(self, images: StoredImages, numbers: Sequence[int], zoom: float) -> None:
        """`numbers`: which pictures to look at. zoom: how much enlarged the network sees them."""
        self._images, self._numbers, self._zoom = images, numbers, zoom

    def __call__(self, network: UNet) -> dict[str, float]:
        """Return intersection over union of branch and middle line, and errors of direction."""
        model = Model(
            network=network,
            channels=network.channels,
            zoom=self._zoom,
            grouping=Grouping(),
            calibration=UNCALIBRATED,
            least_score=0.0,
        )
        segmenter = UNetSegmenter(model, bfloat16=has_fast_bfloat16())
        totals, turns = np.zeros(4), [np.zeros(0)]
        for number in self._numbers:
            maps = np.array(self._images.maps(number))
            seen = segmenter.maps(np.array(self._images.color(number)))
            counts, turn = _compared(_on_grid(seen, maps.shape[:2]), maps)
            totals += counts
            turns.append(turn)
        apart = np.concatenate([*turns, [90.0] if totals[0] == 0 else []])
        return {
            "val_iou": float(totals[0] / max(totals[1], 1)),
            "val_centre_iou": float(totals[2] / max(totals[3], 1)),
            "val_angle_median": float(np.median(apart)),
            "val_angle_p90": float(np.percentile(apart, 90)),
        }


def _on_grid(seen: Float32Array, size: tuple[int, int]) -> Float32Array:
    """Return the maps (5, h, w) at the size (h, w) of the labels."""
    return np.stack([cv2.resize(one, size[::-1], interpolation=cv2.INTER_LINEAR) for one in seen])


def _compared(seen: Float32Array, maps: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return common and united cells of branch and centre, and angles apart in degrees."""
    judged = maps[..., STATE] != Target.IGNORE
    wood, middle = maps[..., STATE] == Target.BRANCH, maps[..., CENTRE] == 1
    branch, centre, cosine, sine, _ = seen
    found, line = (branch > 0) & judged, (centre > 0) & judged
    counts = [found & wood, found | wood, line & middle, line | middle]
    angle = 0.5 * np.arctan2(sine, cosine)
    true = maps[..., ANGLE] * (np.pi / ANGLE_STEPS)
    apart = np.abs(np.mod(angle - true + np.pi / 2, np.pi) - np.pi / 2)
    return np.array([c.sum() for c in counts], float), np.degrees(apart[found & wood])
