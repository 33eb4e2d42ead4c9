"""How likely a strand is one branch, as one would label it: a small network looks along it.

It sees a strip around the strand, laid out along its axis and half its length longer at either
end, of everything the large network knows there: where it stops, what it touches, what it goes on
in. All strands of a picture are scored at once.
"""

from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from canopy_skel.frame import Float32Array
from canopy_skel.geometry import FloatArray
from canopy_skel.segmenters.unet.grouping import Candidates
from canopy_skel.segmenters.unet.network import Maps
from canopy_skel.segmenters.unet.targets import STRIDE

ALONG, ACROSS = 32, 9
"""Samples of a strip."""
BESIDE = 2
"""Channels of a strip besides what the large network knows: what is the strand itself, and what is
in the picture at all."""
_BEYOND = 1.5
_SIDE_RADII, _LEAST_SIDE_CELLS = 3.0, 4.0
_MOST_LOGIT = 8.0
_MOST_SPREADS = 5.0
_JUDGES, _WIDTH, _UNITS = 3, 32, 48
_DROPPED = 0.2
_BATCH = 512
_MAP = {name: place for place, name in enumerate(Maps._fields)}


class _Judge(nn.Module):
    def __init__(self, channels: int) -> None:
        super().__init__()
        width, wide = _WIDTH, 2 * _WIDTH
        self.look = nn.Sequential(
            nn.Conv2d(channels, width, 3, (2, 1), 1),
            nn.ReLU(),
            nn.Conv2d(width, width, 3, 2, 1),
            nn.ReLU(),
            nn.Conv2d(width, wide, 3, 2, 1),
            nn.ReLU(),
            nn.Conv2d(wide, wide, 3, 1, 1),
            nn.ReLU(),
            nn.Flatten(),
        )
        self.decide = nn.Sequential(
            nn.Dropout(_DROPPED),
            nn.Linear(wide * (ALONG // 8) * (-(-ACROSS // 4)), _UNITS),
            nn.ReLU(),
            nn.Dropout(_DROPPED),
            nn.Linear(_UNITS, 1),
        )

    def forward(self, strips: Tensor) -> Tensor:
        logits: Tensor = self.decide(self.look(strips))[:, 0]
        return logits.float()


class Scorer(nn.Module):
    """From strips to logits: the mean of what several judges say of a strip seen from either end.

    Buffers: `middle` and `spread` of each channel of what it was fitted to; `slope` and `shift`
    make its logits honest; `seen`: 0 where it never saw an example, and says one half of all.
    """

    middle: Tensor
    spread: Tensor
    slope: Tensor
    shift: Tensor
    seen: Tensor

    def __init__(self, known: int) -> None:
        """`known`: how many channels the large network knows, see `UNet.known`."""
        super().__init__()
        channels = known + BESIDE
        self.judges = nn.ModuleList(_Judge(channels) for _ in range(_JUDGES))
        self.register_buffer("middle", torch.zeros(channels))
        self.register_buffer("spread", torch.ones(channels))
        self.register_buffer("slope", torch.ones(()))
        self.register_buffer("shift", torch.zeros(()))
        self.register_buffer("seen", torch.zeros(()))

    def forward(self, strips: Tensor) -> Tensor:
        """Return (N,) logits of (N, C, ALONG, ACROSS) strips, see `strips_of`."""
        views = [
            self.standardised(mirrored(strips, along=turned, across=turned))
            for turned in (False, True)
        ]
        said = [judge(view) for judge in self.judges for view in views]
        return self.seen * (self.slope * torch.stack(said).mean(dim=0) + self.shift)

    def standardised(self, strips: Tensor) -> Tensor:
        """Return strips as judges want them."""
        z = (strips - self.middle[:, None, None]).div_(self.spread[:, None, None])
        return z.clamp_(-_MOST_SPREADS, _MOST_SPREADS)

    def scores(
        self, known: Float32Array, candidates: Candidates, *, bfloat16: bool = False
    ) -> FloatArray:
        """Return (N,) scores in (0, 1) of candidates. known: (K, h, w), see `UNet.known`."""
        parts = [np.zeros(0)]
        for first in range(0, len(candidates.cells), _BATCH):
            some = replace(
                candidates,
                cells=candidates.cells[first : first + _BATCH],
                way=candidates.way[first : first + _BATCH],
            )
            strips = torch.from_numpy(strips_of(known, some))
            with torch.inference_mode(), torch.autocast("cpu", torch.bfloat16, enabled=bfloat16):
                parts.append(torch.sigmoid(self(strips)).double().numpy())
        return np.concatenate(parts)


def mirrored(strips: Tensor, *, along: bool, across: bool) -> Tensor:
    """Return (N, C, ALONG, ACROSS) strips as they were if the picture were mirrored."""
    for wanted, axis, way in ((along, 2, "middle_u"), (across, 3, "middle_v")):
        if wanted:
            strips = strips.flip(axis)
            strips[:, [_MAP["sine"], _MAP[way]]] *= -1
    return strips


@dataclass(frozen=True, kw_only=True, eq=False, slots=True)
class _Axis:
    """Of N strands, in cells: middle (u, v), angle, half the length and half the strip's width."""

    u: FloatArray
    v: FloatArray
    angle: FloatArray
    half: FloatArray
    side: FloatArray
    log_radius: FloatArray


def strips_of(known: Float32Array, candidates: Candidates) -> Float32Array:
    """Return (N, K + BESIDE, ALONG, ACROSS) strips of what is known (K, h, w) of a picture.

    Directions and ways are turned to the strand's axis; radius and length are those beside the
    strand's own.
    """
    height, width = candidates.size
    shape = len(candidates.cells), len(known) + BESIDE, ALONG, ACROSS
    out = np.zeros(shape, dtype=np.float32)
    if not len(out):
        return out
    axis = _axis_of(known, candidates)
    along = np.linspace(-_BEYOND, _BEYOND, ALONG)[:, None] * axis.half[:, None, None]
    across = np.linspace(-1.0, 1.0, ACROSS) * axis.side[:, None, None]
    cosine, sine = np.cos(axis.angle)[:, None, None], np.sin(axis.angle)[:, None, None]
    u = axis.u[:, None, None] + along * cosine - across * sine
    v = axis.v[:, None, None] + along * sine + across * cosine
    out[:, : len(known)] = _sampled(known, u, v)
    _turn(out, axis)
    column, row = np.rint(u).astype(np.int64), np.rint(v).astype(np.int64)
    inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    place = np.where(inside, row * width + column, height * width)
    own = np.zeros(height * width + 1, dtype=np.bool_)
    for number, cells in enumerate(candidates.cells):
        own[cells] = True
        out[number, len(known)] = own[place[number]]
        own[cells] = False
    out[:, len(known) + 1] = inside
    return out


def _axis_of(known: Float32Array, candidates: Candidates) -> _Axis:
    parts = []
    for cells in candidates.cells:
        row, column = np.divmod(cells.astype(np.int64), candidates.size[1])
        u, v = column.mean(), row.mean()
        du, dv = column - u, row - v
        angle = 0.5 * np.arctan2(2 * (du * dv).mean(), (du * du).mean() - (dv * dv).mean())
        along = du * np.cos(angle) + dv * np.sin(angle)
        low, high = along.min() - 0.5, along.max() + 0.5
        middle = 0.5 * (low + high)
        log_radius = known[_MAP["log_radius"], row, column].mean() - np.log(STRIDE)
        parts.append(
            (
                u + middle * np.cos(angle),
                v + middle * np.sin(angle),
                angle,
                0.5 * (high - low),
                max(_SIDE_RADII * np.exp(log_radius), _LEAST_SIDE_CELLS),
                log_radius,
            )
        )
    u, v, angle, half, side, log_radius = np.array(parts).T
    return _Axis(u=u, v=v, angle=angle, half=half, side=side, log_radius=log_radius)


def _sampled(known: Float32Array, u: FloatArray, v: FloatArray) -> Float32Array:
    """Return (N, K, ALONG, ACROSS) of what is known, between cells; zero outside."""
    height, width = known.shape[1:]
    grid = np.stack([2 * (u + 0.5) / width - 1, 2 * (v + 0.5) / height - 1], axis=-1)
    grid = grid.astype(np.float32).reshape(1, -1, ACROSS, 2)
    found = functional.grid_sample(
        torch.from_numpy(known)[None], torch.from_numpy(grid), align_corners=False
    )
    strips = found[0].reshape(len(known), -1, ALONG, ACROSS).permute(1, 0, 2, 3)
    return np.asarray(strips.numpy(), dtype=np.float32)


def _turn(strips: Float32Array, axis: _Axis) -> None:
    """Say of the maps of a strip what they are along and across it, in place."""
    logits = [_MAP["branch"], _MAP["centre"]]
    strips[:, logits] = np.clip(strips[:, logits], -_MOST_LOGIT, _MOST_LOGIT)
    for u, v, angle in (
        ("cosine", "sine", 2 * axis.angle),
        ("middle_u", "middle_v", axis.angle),
    ):
        x, y = strips[:, _MAP[u]], strips[:, _MAP[v]]
        c, s = np.cos(angle)[:, None, None], np.sin(angle)[:, None, None]
        strips[:, [_MAP[u], _MAP[v]]] = np.stack([x * c + y * s, y * c - x * s], axis=1)
    own = axis.log_radius + np.log(STRIDE)
    strips[:, _MAP["log_radius"]] -= own[:, None, None]
    strips[:, _MAP["log_length"]] -= np.log(2 * STRIDE * axis.half)[:, None, None]
