"""From the network's maps to instances: slender, straight, disjoint (no boxes, no suppression).

The middle lines of neighbouring branches lie apart even where their masks touch: the
middle-line map is thinned, chained along the direction field, cut where it bends, and grown to
full width.
"""

from dataclasses import dataclass

import numpy as np
from scipy.special import expit

from canopy_skel.frame import Float32Array
from canopy_skel.geometry import FloatArray
from canopy_skel.kernels import strands
from canopy_skel.segmenters.unet.features import measured
from canopy_skel.segmenters.unet.joining import joined
from canopy_skel.segmenters.unet.targets import STRIDE

_TRIES = 5
_SLENDER = 1.2


@dataclass(frozen=True, kw_only=True, slots=True)
class Grouping:
    """How maps become instances; lengths in pixels of the picture.

    branch, centre: least probability of a cell on a branch, on a middle line. outline: that of a
    pixel in the finished mask; what is only likely would make wood thick (a third of the choosing
    pictures: twigs 20 % too thick at .4, 6 % at .75, at the price of line-AP). gate_deg: largest
    turn, ratio: largest logarithmic step of the radius from cell to cell. bend_*: a strand is cut
    where it leaves its chord by more than each of these. reach: how many radii it grows from its
    middle.
    """

    branch: float = 0.4
    centre: float = 0.15
    outline: float = 0.6
    gate_deg: float = 14.0
    ratio: float = 0.6
    bend_px: float = 2.0
    bend_share: float = 0.1
    bend_radii: float = 0.5
    reach: float = 1.15
    least_pixels: int = 100
    least_length_px: float = 20.0


@dataclass(frozen=True, kw_only=True, eq=False, slots=True)
class Strands:
    """Instances on the network's grid.

    label: (h, w) int32, 0 = none. surplus: (h, w), how far the branch logit is above the outline's.
    features: (N, F) of instance i at i - 1, see `features`.
    """

    label: strands.I32
    surplus: Float32Array
    features: FloatArray


def grouped(maps: Float32Array, grouping: Grouping) -> Strands:
    """Group (5, h, w) maps: logits of branch and centre, cos 2θ, sin 2θ, log radius in pixels."""
    log_cell = np.float32(np.log(STRIDE))
    inside = maps[0] > _logit(grouping.branch)
    smooth = np.zeros_like(maps[1:])
    strands.smoothed(inside, maps[1:], smooth)
    centre, field = smooth[0], smooth[1:]
    field[2] -= log_cell
    core = inside & (centre > _logit(grouping.centre))
    core[[0, -1]], core[:, [0, -1]] = False, False
    cells = strands.thinned(core)
    number = np.full(inside.shape, -1, dtype=np.int32)
    number[cells[:, 0], cells[:, 1]] = np.arange(len(cells))
    gate = np.array([np.cos(2 * np.radians(grouping.gate_deg)), grouping.ratio])
    order, starts = strands.chains(strands.links(number, cells, field, gate, _TRIES))
    cells = cells[order]
    rule = np.array([grouping.bend_px / STRIDE, grouping.bend_share, grouping.bend_radii])
    least = 0.4 * grouping.least_length_px / STRIDE
    pieces = strands.straight_pieces(cells, starts, field[2], rule, least)
    paths = joined([cells[begin:end] for begin, end in pieces], field, rule)
    paths.sort(key=len, reverse=True)
    ends = np.cumsum([0, *map(len, paths)])
    label = np.empty(inside.shape, dtype=np.int32)
    together = np.concatenate([np.empty((0, 2), np.int32), *paths])
    count = strands.painted(together, np.stack([ends[:-1], ends[1:]], axis=1), field[2], label)
    middle = label.copy()
    strands.grown(label, inside, field[2], grouping.reach)
    measures = measured(label, middle, count, maps, field[2])
    wanted = measures.pixels >= grouping.least_pixels
    wanted &= measures.length_px >= grouping.least_length_px
    wanted &= measures.length_px**2 > _SLENDER * measures.pixels
    kept = np.zeros(count + 1, dtype=np.int32)
    kept[1:][wanted] = np.arange(1, int(wanted.sum()) + 1)
    return Strands(
        label=kept[label],
        surplus=maps[0] - np.float32(_logit(grouping.outline)),
        features=measures.features[wanted],
    )


def _logit(probability: float) -> float:
    return float(np.log(probability / (1 - probability)))


@dataclass(frozen=True, kw_only=True, slots=True)
class Calibration:
    """From features to the probability that an instance is a branch: a logistic regression.

    weights: one per name of `features.FEATURES`.
    """

    weights: tuple[float, ...]
    bias: float

    def scores(self, features: FloatArray) -> FloatArray:
        """Return (N,) scores in (0, 1)."""
        return np.asarray(expit(features @ np.array(self.weights) + self.bias))
