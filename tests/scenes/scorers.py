"""Scorers that nobody taught."""

import torch

from canopy_skel.segmenters.unet.scorer import Scorer
from canopy_skel.segmenters.unet.weights import untaught_scorer


def constant_scorer(channels: tuple[int, ...], logit: float) -> Scorer:
    """Return a scorer that says the same of everything."""
    scorer = untaught_scorer(channels).eval()
    scorer.seen.fill_(1.0)
    with torch.no_grad():
        for judge in scorer.judges:
            judge.decide[-1].weight.zero_()
            judge.decide[-1].bias.fill_(logit)
    return scorer
