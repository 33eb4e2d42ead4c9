"""What a labelled picture asks of the network's maps, at its output stride.

Stored as bytes, so that a data set fits into memory: see `Target`. Where in its piece a cell lies
is not stored but worked out of each crop (`places_of`): what a crop cuts off is no part of a piece.
"""

from enum import IntEnum

import numpy as np

from canopy_skel.frame import Float32Array, UInt8Array
from canopy_skel.geometry import FloatArray
from canopy_skel.kernels import centreline
from canopy_skel.segmenters.labels import LabelledImage

STRIDE = 2
TARGETS = 5
"""How many bytes a cell has; they follow."""
STATE, CENTRE, ANGLE, RADIUS, PIECE = range(TARGETS)
ANGLE_STEPS = 255
"""An angle modulo 180 degrees as a byte: byte / 255 * pi."""
RADIUS_PX = (0.5, 500.0)
"""What the bytes 0 and 255 stand for in the radius map, logarithmic in between."""
_NUMBERS = 255
_LINE_POINTS = 24
_CENTRE_RADII = 0.35
_CENTRE_LEAST_PX = 1.5


class Target(IntEnum):
    """The STATE of a cell: part of nothing, of a branch, or of what nobody is judged by."""

    NONE = 0
    BRANCH = 1
    IGNORE = 2


def targets_of(image: LabelledImage) -> UInt8Array:
    """Return (H / 2, W / 2, 5) bytes: STATE, CENTRE (0 or 1), ANGLE, RADIUS, PIECE.

    A cell belongs to a branch, or is ignored, when half of its pixels are. The centre band is the
    inner third of a branch, three pixels at least.

    PIECE: which instance, 0 = none. As a byte holds no more, instance 256 is 1 again. `places_of`
    takes two of one number for one piece and asks wrong places of both; but drawn pictures have
    fewer than a hundred instances, and of one with hundreds a crop seldom shows both.
    """
    instances, ignored = _halved(image)
    states = np.where(ignored >= 0.5, Target.IGNORE, Target.NONE)
    states = np.where(instances > 0, Target.BRANCH, states)
    maps = np.zeros((*instances.shape, TARGETS), dtype=np.uint8)
    maps[..., STATE] = states
    numbers = (instances.astype(np.int64) - 1) % _NUMBERS + 1
    maps[..., PIECE] = np.where(instances > 0, numbers, 0)
    if not image.lines:
        return maps
    lines = [_evened(line) for line in image.lines]
    starts = np.cumsum([0, *map(len, lines)]).astype(np.int64)
    near = np.zeros((*instances.shape, 3), dtype=np.float32)
    centreline.nearest_on_lines(instances, np.concatenate(lines), starts, STRIDE, near)
    band = np.maximum(_CENTRE_RADII * near[..., 2], _CENTRE_LEAST_PX)
    maps[..., CENTRE] = (instances > 0) & (near[..., 0] <= band)
    maps[..., ANGLE] = np.rint(np.mod(near[..., 1], np.pi) / np.pi * ANGLE_STEPS) % ANGLE_STEPS
    maps[..., RADIUS] = radius_bytes(near[..., 2])
    return maps


def radius_bytes(radius_px: Float32Array) -> UInt8Array:
    """Return radii as bytes, see `RADIUS_PX`."""
    low, high = np.log(RADIUS_PX)
    scaled = (np.log(np.maximum(radius_px, 1e-3)) - low) / (high - low)
    return np.asarray(np.rint(255 * np.clip(scaled, 0, 1)), dtype=np.uint8)


def places_of(maps: UInt8Array) -> Float32Array:
    """Return (h, w, 3) float32: `middle_u`, `middle_v` and `log_length` of `network.Maps`.

    maps: (h, w, 5) as `targets_of` makes them, or a crop of that. A piece runs along the mean
    direction of its cells, from the first to the last. Zero where there is no branch.
    """
    out = np.zeros((*maps.shape[:2], 3), dtype=np.float32)
    rows, columns = np.nonzero(maps[..., PIECE])
    if not len(rows):
        return out
    own = maps[rows, columns, PIECE].astype(np.int64)
    turn = maps[rows, columns, ANGLE] * (2 * np.pi / ANGLE_STEPS)
    sine, cosine = np.bincount(own, np.sin(turn)), np.bincount(own, np.cos(turn))
    angle = 0.5 * np.arctan2(sine, cosine)[own]
    along = columns * np.cos(angle) + rows * np.sin(angle)
    low, high = np.full(_NUMBERS + 1, np.inf), np.full(_NUMBERS + 1, -np.inf)
    np.minimum.at(low, own, along)
    np.maximum.at(high, own, along)
    low, high = low[own], high[own]
    half = 0.5 * (high - low + 1.0)
    share = (0.5 * (low + high) - along) / half
    out[rows, columns] = np.column_stack(
        [share * np.cos(angle), share * np.sin(angle), np.log(2 * STRIDE * half)]
    )
    return out


def _halved(image: LabelledImage) -> tuple[np.ndarray, np.ndarray]:
    """Return instances and the share of ignored pixels by cell; odd last rows fall away."""
    height, width = (size // STRIDE * STRIDE for size in image.instances.shape)

    def cells(array: np.ndarray) -> np.ndarray:
        shape = (height // STRIDE, STRIDE, width // STRIDE, STRIDE)
        return array[:height, :width].reshape(shape).swapaxes(1, 2).reshape(*shape[::2], -1)

    labels = cells(image.instances)
    highest = labels.max(axis=-1)
    count = (labels == highest[..., None]).sum(axis=-1)
    instances = np.where(count >= 2, highest, 0).astype(np.uint16)
    return instances, cells(image.ignore).mean(axis=-1)


def _evened(line: FloatArray) -> FloatArray:
    """Return a line with at most 24 points, evenly spaced, kinks between vertices smoothed."""
    step = np.linalg.norm(np.diff(line[:, :2], axis=0), axis=1)
    along = np.concatenate([[0.0], np.cumsum(step)])
    count = int(np.clip(along[-1] / 6.0, 1, _LINE_POINTS - 1)) + 1
    stations = np.linspace(0.0, along[-1], count)
    return np.stack([np.interp(stations, along, line[:, k]) for k in range(3)], axis=1)
