"""From the network's maps to instances: slender, straight, disjoint (no boxes).

The middle lines of neighbouring branches lie apart even where their masks touch: the
middle-line map is thinned, chained along the direction field, cut where it bends, and grown to
full width. Done at several thresholds of that map, it parts what is seen in several ways; what a
`scorer.Scorer` is surest of is taken first.
"""

import itertools
from dataclasses import dataclass

import numpy as np

from canopy_skel.frame import Float32Array
from canopy_skel.geometry import BoolArray, FloatArray, IntArray
from canopy_skel.kernels import strands
from canopy_skel.segmenters.unet.joining import joined
from canopy_skel.segmenters.unet.targets import STRIDE

_TRIES = 5
_SLENDER = 1.2


@dataclass(frozen=True, kw_only=True, slots=True)
class Grouping:
    """How maps become instances; lengths in pixels of the picture.

    branch: least probability of a cell on a branch. centres: of one on a middle line, one for each
    way of parting what is seen. outline: that of a pixel in the finished mask; what is only likely
    would make wood thick (a third of the choosing pictures: twigs 20 % too thick at .4, 6 % at .75,
    at the price of line-AP). gate_deg: largest turn, ratio: largest logarithmic step of the radius
    from cell to cell. bend_*: a strand is cut
    where it leaves its chord by more than each of these. reach: how many radii it grows from its
    middle. taken: the largest share of a strand that surer ones may have taken of it.
    """

    branch: float = 0.4
    centres: tuple[float, ...] = (0.02, 0.05, 0.15, 0.4, 0.65)
    outline: float = 0.6
    gate_deg: float = 14.0
    ratio: float = 0.6
    bend_px: float = 2.0
    bend_share: float = 0.1
    bend_radii: float = 0.5
    reach: float = 1.15
    least_pixels: int = 100
    least_length_px: float = 20.0
    taken: float = 0.4


@dataclass(frozen=True, kw_only=True, eq=False, slots=True)
class Candidates:
    """Strands that may be branches, N of them, on the network's grid; they overlap.

    size: (h, w) of the grid. cells: of each, its places in the flattened grid, ascending. way:
    (N,) which of `Grouping.centres` it comes from; those of one are disjoint.
    """

    size: tuple[int, int]
    cells: tuple[strands.I64, ...]
    way: IntArray


@dataclass(frozen=True, kw_only=True, eq=False, slots=True)
class Strands:
    """Instances on the network's grid.

    label: (h, w) int32, 0 = none. surplus: (h, w), how far the branch logit is above the outline's.
    log_radius: (h, w), of the radius in cells.
    """

    label: strands.I32
    surplus: Float32Array
    log_radius: Float32Array


def candidates_of(maps: Float32Array, grouping: Grouping) -> Candidates:
    """Group (8, h, w) maps in several ways; what comes out twice counts once."""
    inside = maps[0] > _logit(grouping.branch)
    smooth = np.zeros((4, *inside.shape), dtype=np.float32)
    strands.smoothed(inside, maps[1:5], smooth)
    centre, field = smooth[0], smooth[1:]
    field[2] -= np.float32(np.log(STRIDE))
    cells: list[strands.I64] = []
    ways: list[int] = []
    known: set[bytes] = set()
    for way, least in enumerate(grouping.centres):
        core = inside & (centre > _logit(least))
        for own in _strands(core, inside, field, grouping):
            name = own.tobytes()
            if name not in known:
                known.add(name)
                cells.append(own)
                ways.append(way)
    height, width = inside.shape
    return Candidates(size=(height, width), cells=tuple(cells), way=np.array(ways, dtype=np.int64))


def chosen(
    maps: Float32Array, candidates: Candidates, scores: FloatArray, grouping: Grouping
) -> tuple[Strands, FloatArray]:
    """Return what candidates come to, the surest first, and the score of instance i at i - 1.

    One that surer ones have taken too much of is dropped; else it keeps what is left, which may be
    in two parts, or less than `least_pixels`.
    """
    label = np.zeros(maps[0].size, dtype=np.int32)
    taken: list[float] = []
    for place in np.argsort(-scores, kind="stable").tolist():
        cells = candidates.cells[place]
        free = cells[label[cells] == 0]
        if len(free) < (1 - grouping.taken) * len(cells):
            continue
        taken.append(float(scores[place]))
        label[free] = len(taken)
    strands_ = Strands(
        label=label.reshape(candidates.size),
        surplus=surplus_of(maps, grouping),
        log_radius=log_radius_of(maps),
    )
    return strands_, np.array(taken)


def surplus_of(maps: Float32Array, grouping: Grouping) -> Float32Array:
    """Return how far the branch logit is above the outline's, (h, w)."""
    return np.asarray(maps[0] - np.float32(_logit(grouping.outline)), dtype=np.float32)


def log_radius_of(maps: Float32Array) -> Float32Array:
    """Return the logarithm of the radius in cells, (h, w)."""
    return np.asarray(maps[4] - np.float32(np.log(STRIDE)), dtype=np.float32)


def _strands(
    core: BoolArray, inside: BoolArray, field: Float32Array, grouping: Grouping
) -> list[strands.I64]:
    """Return the cells of strands that a core (h, w) of middle lines parts `inside` into.

    field: (3, h, w) cos 2θ, sin 2θ, log radius in cells.
    """
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
    strands.grown(label, inside, field[2], grouping.reach)
    place = np.flatnonzero(label > 0)  # of truths NumPy counts faster
    own = label.ravel()[place] - 1
    ends = np.cumsum([0, *np.bincount(own, minlength=count)])
    place = place[np.argsort(own, kind="stable")]
    width = inside.shape[1]
    parts = [place[begin:end] for begin, end in itertools.pairwise(ends)]
    wanted = _slender(place // width, place % width, ends, grouping)
    return [part for part, good in zip(parts, wanted, strict=True) if good]


def _slender(rows: IntArray, columns: IntArray, ends: IntArray, grouping: Grouping) -> BoolArray:
    """Say which groups of cells, from one of `ends` to the next, are long and slender enough."""
    cells = np.diff(ends)
    own = np.repeat(np.arange(len(cells)), cells)

    def mean(values: FloatArray | IntArray) -> FloatArray:
        return np.bincount(own, values, len(cells)) / np.maximum(cells, 1)

    u, v = columns - mean(columns)[own], rows - mean(rows)[own]
    uu, vv, uv = mean(u * u), mean(v * v), mean(u * v)
    along = 0.5 * (uu + vv) + np.sqrt(0.25 * (uu - vv) ** 2 + uv**2)
    length_px, pixels = STRIDE * np.sqrt(12 * along + 1), STRIDE**2 * cells
    long = (pixels >= grouping.least_pixels) & (length_px >= grouping.least_length_px)
    return np.asarray(long & (length_px**2 > _SLENDER * pixels))


def _logit(probability: float) -> float:
    return float(np.log(probability / (1 - probability)))
