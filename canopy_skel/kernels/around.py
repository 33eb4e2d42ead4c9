"""What lies around a pixel, in rings: does its like go on along a line, and what lies beside it?

And what a network made of the picture there.
"""

import math

import numpy as np
from numpy.typing import NDArray

from canopy_skel.kernels.compiled import inner, kernel

Floats32 = NDArray[np.float32]
RINGS_PX = (2, 5, 12, 24)
DIRECTIONS = 16
HINTS = 5
OWN = 3 + HINTS
PER_RING = 12
FIGURES = OWN + PER_RING * len(RINGS_PX)
"""Own: mean log odds, log odds, depth, the network's hints. Per ring: log odds along the best line
(the lower of its two sides), across it (the higher), all around; how much lighter it is along,
across (the lightest, the darkest); share of the ring at the same depth, and of two: along; across
farther, across without depth; share under masks, and whether a mask lies along."""


@inner("int64[:,:,::1](UniTuple(int64, 4))")
def ring_offsets(rings_px: tuple[int, ...]) -> NDArray[np.int64]:
    """Return (rings, DIRECTIONS, 2): steps down and right to places around a pixel."""
    offsets = np.zeros((len(rings_px), DIRECTIONS, 2), dtype=np.int64)
    for r, ring_px in enumerate(rings_px):
        for k in range(DIRECTIONS):
            angle = 2.0 * math.pi * k / DIRECTIONS
            offsets[r, k, 0] = math.floor(math.sin(angle) * ring_px + 0.5)
            offsets[r, k, 1] = math.floor(math.cos(angle) * ring_px + 0.5)
    return offsets


@inner("int64(float32[:])")
def best_line(odds: Floats32) -> int:
    """Return the direction whose two sides both look most like wood."""
    best, highest = 0, np.float32(-np.inf)
    for k in range(DIRECTIONS // 2):
        lower = min(odds[k], odds[k + DIRECTIONS // 2])
        if lower > highest:
            best, highest = k, lower
    return best


@inner("void(float32[:,::1], float32, float32, float32[::1])")
def ring_figures(ring: Floats32, lightness: float, z: float, row: Floats32) -> None:
    """Write what one ring (DIRECTIONS, 4) shows around a pixel into `row` (PER_RING,)."""
    half, quarter = DIRECTIONS // 2, DIRECTIONS // 4
    tolerance_m = 0.012 + 0.008 * z * z
    a = best_line(ring[:, 0])
    b, c, d = a + half, (a + quarter) % DIRECTIONS, (a + quarter + half) % DIRECTIONS
    odds = same = masked = np.float32(0.0)
    for k in range(DIRECTIONS):
        odds += ring[k, 0]
        same += np.float32(abs(ring[k, 2] - z) <= tolerance_m)
        masked += ring[k, 3]
    row[0] = min(ring[a, 0], ring[b, 0])
    row[1] = max(ring[c, 0], ring[d, 0])
    row[2] = odds / DIRECTIONS
    row[3] = 0.5 * (ring[a, 1] + ring[b, 1]) - lightness
    row[4] = max(ring[c, 1], ring[d, 1]) - lightness
    row[5] = min(ring[c, 1], ring[d, 1]) - lightness
    row[6] = same / DIRECTIONS
    # Python's own true and true are two; NumPy's, where nothing is compiled, are one.
    row[7] = int(abs(ring[a, 2] - z) <= tolerance_m) + int(abs(ring[b, 2] - z) <= tolerance_m)
    row[8] = int(ring[c, 2] - z > tolerance_m) + int(ring[d, 2] - z > tolerance_m)
    row[9] = int(ring[c, 2] == 0.0) + int(ring[d, 2] == 0.0)
    row[10] = masked / DIRECTIONS
    row[11] = max(ring[a, 3], ring[b, 3])


@inner("void(float32[:,:,::1], float64, float64, float32[::1])")
def hints_at(hints: Floats32, y: float, x: float, row: Floats32) -> None:
    """Write the hints (h, w, HINTS) at a place between cells into `row`; rims go on beyond."""
    y, x = min(max(y, 0.0), hints.shape[0] - 1.0), min(max(x, 0.0), hints.shape[1] - 1.0)
    i, j = min(int(y), max(hints.shape[0] - 2, 0)), min(int(x), max(hints.shape[1] - 2, 0))
    below, right = min(i + 1, hints.shape[0] - 1), min(j + 1, hints.shape[1] - 1)
    b, a = np.float32(y - i), np.float32(x - j)
    one = np.float32(1.0)
    for k in range(HINTS):
        upper = (one - a) * hints[i, j, k] + a * hints[i, right, k]
        lower = (one - a) * hints[below, j, k] + a * hints[below, right, k]
        row[k] = (one - b) * upper + b * lower


@inner(
    "void(float32[:,:,::1], float32[:,:,::1], float32[:], int64[:], int64[:], int64[:,:,::1],"
    " float32[::1], float32[:,::1], int64)"
)
def pixel_figures(
    layers: Floats32,
    hints: Floats32,
    mean_odds: Floats32,
    v: NDArray[np.int64],
    u: NDArray[np.int64],
    offsets: NDArray[np.int64],
    row: Floats32,
    ring: Floats32,
    i: int,
) -> None:
    """Write the figures of pixel i into `row` (FIGURES,); `ring` (DIRECTIONS, 4) is room for it."""
    y, x = v[i], u[i]
    lightness, z = layers[y, x, 1], layers[y, x, 2]
    row[0], row[1], row[2] = mean_odds[i], layers[y, x, 0], z
    at_y = (y + 0.5) * hints.shape[0] / layers.shape[0] - 0.5
    at_x = (x + 0.5) * hints.shape[1] / layers.shape[1] - 0.5
    hints_at(hints, at_y, at_x, row[3:OWN])
    for r in range(len(offsets)):
        for k in range(DIRECTIONS):
            beside_y = min(max(y + offsets[r, k, 0], 0), layers.shape[0] - 1)
            beside_x = min(max(x + offsets[r, k, 1], 0), layers.shape[1] - 1)
            for layer in range(4):
                ring[k, layer] = layers[beside_y, beside_x, layer]
        ring_figures(ring, lightness, z, row[OWN + r * PER_RING : OWN + (r + 1) * PER_RING])


@kernel("float32[:,::1](float32[:,:,::1], float32[:,:,::1], float32[:], int64[:], int64[:])")
def figures_around(
    layers: Floats32,
    hints: Floats32,
    mean_odds: Floats32,
    v: NDArray[np.int64],
    u: NDArray[np.int64],
) -> Floats32:
    """Return the figures (N, FIGURES) of pixels (v, u); the picture goes on beyond its rims.

    layers: (H, W, 4) log odds of wood by colour, lightness, depth_m (0: none), under a mask.
    hints: (h, w, HINTS) of the network, on a grid of its own over the same picture.
    """
    rows = np.zeros((len(v), FIGURES), dtype=np.float32)
    ring, offsets = np.zeros((DIRECTIONS, 4), dtype=np.float32), ring_offsets(RINGS_PX)
    for i in range(len(v)):
        pixel_figures(layers, hints, mean_odds, v, u, offsets, rows[i], ring, i)
    return rows


@kernel(
    "float32[::1](float32[:,:,::1], float32[:,:,::1], float32[:], int64[:], int64[:],"
    " float32[:,::1], float32[::1], float32[::1], float64)"
)
def wood_log_odds(
    layers: Floats32,
    hints: Floats32,
    mean_odds: Floats32,
    v: NDArray[np.int64],
    u: NDArray[np.int64],
    first: Floats32,
    first_bias: Floats32,
    second: Floats32,
    second_bias: float,
) -> Floats32:
    """Return the log odds (N,) of wood: one hidden layer (FIGURES, K) of what lies around.

    Raises:
        ValueError: the layer is of other figures.
    """
    if len(first) != FIGURES or first.shape[1] != len(first_bias) or len(second) != len(first_bias):
        raise ValueError("the model of pixels is not of these figures: fit it again")
    found, row = np.zeros(len(v), dtype=np.float32), np.zeros(FIGURES, dtype=np.float32)
    ring, offsets = np.zeros((DIRECTIONS, 4), dtype=np.float32), ring_offsets(RINGS_PX)
    hidden = np.zeros(len(first_bias), dtype=np.float32)
    for i in range(len(v)):
        pixel_figures(layers, hints, mean_odds, v, u, offsets, row, ring, i)
        for k in range(len(hidden)):
            hidden[k] = first_bias[k]
        for j in range(FIGURES):
            for k in range(len(hidden)):
                hidden[k] += row[j] * first[j, k]
        total = np.float32(second_bias)
        for k in range(len(hidden)):
            total += max(hidden[k], np.float32(0.0)) * second[k]
        found[i] = total
    return found
