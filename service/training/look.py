"""A quick look at how a network is doing, taken every few minutes of training."""

from collections.abc import Sequence

import cv2
import numpy as np

from canopy_skel.frame import Float32Array
from canopy_skel.segmenters.unet.grouping import Grouping
from canopy_skel.segmenters.unet.network import UNet
from canopy_skel.segmenters.unet.precision import has_fast_bfloat16
from canopy_skel.segmenters.unet.segmenter import UNetSegmenter
from canopy_skel.segmenters.unet.targets import (
    ANGLE,
    ANGLE_STEPS,
    CENTRE,
    STATE,
    Target,
    places_of,
)
from canopy_skel.segmenters.unet.weights import Model, untaught_scorer
from service.training.store import StoredImages


class Look:
    """Measures the maps, cell by cell, on some pictures of a set."""

    def __init__(self, images: StoredImages, numbers: Sequence[int], zoom: float) -> None:
        """`numbers`: which pictures to look at. zoom: how much enlarged the network sees them."""
        self._images, self._numbers, self._zoom = images, numbers, zoom

    def __call__(self, network: UNet) -> dict[str, float]:
        """Return intersection over union of branch and middle line, and errors where wood is found.

        Those of the direction are in degrees, that of the way to the middle in half lengths.
        """
        model = Model(
            network=network,
            channels=network.channels,
            zoom=self._zoom,
            grouping=Grouping(),
            scorer=untaught_scorer(network.channels),
            least_score=0.0,
        )
        segmenter = UNetSegmenter(model, bfloat16=has_fast_bfloat16())
        totals, turns, ways = np.zeros(4), [np.zeros(0)], [np.zeros(0)]
        for number in self._numbers:
            maps = np.array(self._images.maps(number))
            seen = segmenter.known(np.array(self._images.color(number))).maps
            counts, turn, way = _compared(_on_grid(seen, maps.shape[:2]), maps)
            totals += counts
            turns.append(turn)
            ways.append(way)
        if totals[0] == 0:
            turns, ways = [np.array([90.0])], [np.array([1.0])]
        apart = np.concatenate(turns)
        return {
            "val_iou": float(totals[0] / max(totals[1], 1)),
            "val_centre_iou": float(totals[2] / max(totals[3], 1)),
            "val_angle_median": float(np.median(apart)),
            "val_angle_p90": float(np.percentile(apart, 90)),
            "val_middle": float(np.concatenate(ways).mean()),
        }


def _on_grid(seen: Float32Array, size: tuple[int, int]) -> Float32Array:
    """Return the maps (8, h, w) at the size (h, w) of the labels."""
    return np.stack([cv2.resize(one, size[::-1], interpolation=cv2.INTER_LINEAR) for one in seen])


def _compared(seen: Float32Array, maps: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return common and united cells of branch and centre, and errors by cell that is wood.

    The errors: angles apart in degrees, and ways to the middle apart in half lengths.
    """
    judged = maps[..., STATE] != Target.IGNORE
    wood, middle = maps[..., STATE] == Target.BRANCH, maps[..., CENTRE] == 1
    branch, centre, cosine, sine, _, middle_u, middle_v, _ = seen
    found, line = (branch > 0) & judged, (centre > 0) & judged
    counts = [found & wood, found | wood, line & middle, line | middle]
    angle = 0.5 * np.arctan2(sine, cosine)
    true = maps[..., ANGLE] * (np.pi / ANGLE_STEPS)
    apart = np.abs(np.mod(angle - true + np.pi / 2, np.pi) - np.pi / 2)
    places = places_of(maps)
    astray = np.hypot(middle_u - places[..., 0], middle_v - places[..., 1])
    both = found & wood
    return np.array([c.sum() for c in counts], float), np.degrees(apart[both]), astray[both]
