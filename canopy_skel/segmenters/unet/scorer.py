"""How likely a strand is one branch, as one would label it: a small network looks along it.

It sees a strip around the strand, laid out along its axis and half its length longer at either
end, of everything the large network knows there: where it stops, what it touches, what it goes on
in. All strands of a picture are scored at once.
"""

from dataclasses import replace

import numpy as np
import torch
from torch import Tensor, nn

from canopy_skel.frame import Float32Array
from canopy_skel.geometry import FloatArray
from canopy_skel.kernels import strips
from canopy_skel.segmenters.unet.grouping import Candidates
from canopy_skel.segmenters.unet.network import Known, Maps
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
            nn.ReLU(inplace=True),
            nn.Conv2d(width, width, 3, 2, 1),
            nn.ReLU(inplace=True),
            nn.Conv2d(width, wide, 3, 2, 1),
            nn.ReLU(inplace=True),
            nn.Conv2d(wide, wide, 3, 1, 1),
            nn.ReLU(inplace=True),
            nn.Flatten(),
        )
        self.decide = nn.Sequential(
            nn.Dropout(_DROPPED),
            nn.Linear(wide * (ALONG // 8) * (-(-ACROSS // 4)), _UNITS),
            nn.ReLU(inplace=True),
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
        """`known`: how many maps and features the large network has."""
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
            self.standardised(view) for view in (strips, mirrored(strips, along=True, across=True))
        ]
        if torch.is_autocast_enabled("cpu"):  # once, not in each judge
            views = [view.to(torch.get_autocast_dtype("cpu")) for view in views]
        said = [judge(view) for judge in self.judges for view in views]
        return self.seen * (self.slope * torch.stack(said).mean(dim=0) + self.shift)

    def standardised(self, strips: Tensor) -> Tensor:
        """Return strips as judges want them."""
        z = (strips - self.middle[:, None, None]).div_(self.spread[:, None, None])
        return z.clamp_(-_MOST_SPREADS, _MOST_SPREADS)

    def scores(self, known: Known, candidates: Candidates, *, bfloat16: bool = False) -> FloatArray:
        """Return (N,) scores in (0, 1) of candidates."""
        parts = [np.zeros(0)]
        for first in range(0, len(candidates.cells), _BATCH):
            some = replace(
                candidates,
                cells=candidates.cells[first : first + _BATCH],
                way=candidates.way[first : first + _BATCH],
            )
            looked = torch.from_numpy(strips_of(known, some))
            with torch.inference_mode(), torch.autocast("cpu", torch.bfloat16, enabled=bfloat16):
                parts.append(torch.sigmoid(self(looked)).double().numpy())
        return np.concatenate(parts)


def mirrored(strips: Tensor, *, along: bool, across: bool) -> Tensor:
    """Return (N, C, ALONG, ACROSS) strips as they were if the picture were mirrored."""
    result = strips.flip([axis for axis, wanted in ((2, along), (3, across)) if wanted])
    turned = {"middle_u": along, "middle_v": across, "sine": along != across}
    for name, wanted in turned.items():
        if wanted:
            result[:, _MAP[name]] *= -1
    return result


def strips_of(known: Known, candidates: Candidates) -> Float32Array:
    """Return (N, 8 + K + BESIDE, ALONG, ACROSS) strips of what is known of a picture.

    Directions and ways are turned to the strand's axis; radius and length are those beside the
    strand's own. In memory, the channels of a sample lie side by side, as convolutions like them.
    """
    height, width = candidates.size
    count = len(candidates.cells)
    ends = np.cumsum([0, *map(len, candidates.cells)])
    cells = np.concatenate([np.empty(0, dtype=np.int64), *candidates.cells])
    axes = np.empty((count, strips.AXIS))
    strips.axes(cells, ends, known.maps, STRIDE, axes)
    side = np.maximum(_SIDE_RADII / STRIDE * np.exp(axes[:, 5]), _LEAST_SIDE_CELLS)
    channels = len(known.maps) + len(known.features) + BESIDE
    out = np.zeros((count, ALONG, ACROSS, channels), dtype=np.float32)
    own = np.zeros(height * width, dtype=np.bool_)
    strips.looked_along(
        known.maps, known.features, axes, side, cells, ends, _BEYOND, _MOST_LOGIT, own, out
    )
    return out.transpose(0, 3, 1, 2)
