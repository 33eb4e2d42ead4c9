"""How wrong the maps are."""

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional

from canopy_skel.segmenters.unet.network import Maps
from canopy_skel.segmenters.unet.targets import (
    ANGLE,
    ANGLE_STEPS,
    CENTRE,
    RADIUS,
    RADIUS_PX,
    STATE,
    Target,
)

_EVEN_RADIUS_PX = 8.0
_LIGHTEST, _HEAVIEST = 0.4, 2.0
_SMALL = 1e-4
"""In half lengths squared: keeps the slope of a root finite where nothing is wrong."""


@dataclass(frozen=True, kw_only=True, eq=False, slots=True)
class Loss:
    """The parts of the loss, each a scalar.

    middle: of the way to the middle of the piece, in half lengths. length: of its logarithm.
    """

    branch: Tensor
    centre: Tensor
    direction: Tensor
    radius: Tensor
    middle: Tensor
    length: Tensor

    def total(self, centre_weight: float, piece_weight: float) -> Tensor:
        """Return what is to be made small."""
        shape = self.branch + centre_weight * self.centre + self.direction + 0.5 * self.radius
        return shape + piece_weight * (self.middle + 0.5 * self.length)


def loss_of(maps: Maps, targets: Tensor, places: Tensor) -> Loss:
    """Return the loss of a batch.

    targets: (N, h, w, 5) uint8, see `targets_of`. places: (N, h, w, 3), see `places_of`.

    Ignored cells count nowhere. Thin wood weighs more than stout: a thin branch has few pixels,
    but its skeleton is as long.
    """
    state = targets[..., STATE]
    judged = (state != Target.IGNORE).float()
    branch = (state == Target.BRANCH).float()
    low, high = torch.log(torch.tensor(RADIUS_PX)).tolist()
    log_radius = targets[..., RADIUS].float() / 255 * (high - low) + low
    thin = torch.sqrt(_EVEN_RADIUS_PX / torch.exp(log_radius)).clamp(_LIGHTEST, _HEAVIEST)
    weight = judged * torch.where(branch > 0, thin, torch.ones_like(thin))
    inside = branch * thin
    count = inside.sum() + 1.0
    angle = targets[..., ANGLE].float() * (2 * torch.pi / ANGLE_STEPS)
    apart = (maps.cosine - torch.cos(angle)) ** 2 + (maps.sine - torch.sin(angle)) ** 2
    middle_u, middle_v, log_length = places.unbind(dim=-1)
    astray = (maps.middle_u - middle_u) ** 2 + (maps.middle_v - middle_v) ** 2
    return Loss(
        branch=_found(maps.branch, branch, weight),
        centre=_found(maps.centre, targets[..., CENTRE].float(), weight),
        direction=(apart * inside).sum() / count,
        radius=((maps.log_radius - log_radius).abs() * inside).sum() / count,
        middle=(torch.sqrt(astray + _SMALL) * inside).sum() / count,
        length=((maps.log_length - log_length).abs() * inside).sum() / count,
    )


def _found(logit: Tensor, truth: Tensor, weight: Tensor) -> Tensor:
    """Return cross entropy plus one minus Dice over the whole batch."""
    entropy = functional.binary_cross_entropy_with_logits(logit, truth, weight, reduction="sum")
    share = torch.sigmoid(logit)
    overlap = (weight * share * truth).sum()
    dice = (2 * overlap + 1) / ((weight * (share + truth)).sum() + 1)
    return 2.0 * entropy / weight.sum() + 1 - dice
