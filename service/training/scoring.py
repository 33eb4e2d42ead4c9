"""Teaching the scorer which strands are branches, piece for piece as they are labelled."""

import copy
from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch.nn.functional import binary_cross_entropy_with_logits

from canopy_skel.geometry import FloatArray
from canopy_skel.metrics.lines import LEAST_OVERLAP
from canopy_skel.metrics.segmentation import best_overlaps
from canopy_skel.segment import BranchMask
from canopy_skel.segmenters.labels import LabelledImage
from canopy_skel.segmenters.unet.grouping import (
    Candidates,
    Grouping,
    Strands,
    candidates_of,
    log_radius_of,
    surplus_of,
)
from canopy_skel.segmenters.unet.network import Known
from canopy_skel.segmenters.unet.precision import has_fast_bfloat16
from canopy_skel.segmenters.unet.scorer import (
    ACROSS,
    ALONG,
    BESIDE,
    Scorer,
    mirrored,
    strips_of,
)
from canopy_skel.segmenters.unet.segmenter import UNetSegmenter, masks_of
from canopy_skel.segmenters.unet.weights import Model

Progress = Callable[[str, int, int], None]
"""Told what is done, how much of it, and of how much."""

_TOLD_EVERY = 100
_BATCH = 256
_PEAK_RATE, _GENTLE_RATE, _DECAY = 2e-3, 3e-4, 1e-2
_SOFT = 0.15
"""An overlap this far above or below the least counts fully; between, in proportion."""
_SEEN = 2000
_SEED = 0


@dataclass(frozen=True, kw_only=True, eq=False, slots=True)
class Examples:
    """Strands of labelled pictures; N of them.

    strips: (N, C, ALONG, ACROSS), see `scorer.strips_of`. overlap: (N,) what each has in
    common, by middle line, with the labelled branch it is most like.
    """

    strips: NDArray[np.float16]
    overlap: FloatArray


def examples_of(model: Model, pictures: Iterable[LabelledImage]) -> Examples:
    """Return all that may be branches in some pictures, but what lies on ignored wood."""
    segmenter = UNetSegmenter(model, bfloat16=has_fast_bfloat16())
    channels = len(model.scorer.middle)
    strips, overlap = [np.zeros((0, channels, ALONG, ACROSS), np.float16)], [np.zeros(0)]
    for picture in pictures:
        known = segmenter.known(picture.color_rgb)
        candidates = candidates_of(known.maps, model.grouping)
        masks = _masks(known, candidates, picture, model.grouping)
        common = best_overlaps(masks, picture)
        own = np.array([mask.instance - 1 for mask in masks], dtype=np.int64)
        counts = np.isfinite(common)
        strips.append(strips_of(known, candidates)[own[counts]].astype(np.float16))
        overlap.append(common[counts])
    return Examples(strips=np.concatenate(strips), overlap=np.concatenate(overlap))


def _masks(
    known: Known, candidates: Candidates, picture: LabelledImage, grouping: Grouping
) -> list[BranchMask]:
    """Return masks of all candidates, numbered from 1; a mask may be empty and is left out then."""
    masks: list[BranchMask] = []
    surplus, log_radius = surplus_of(known.maps, grouping), log_radius_of(known.maps)
    ones = np.ones(len(candidates.cells))
    for way in np.unique(candidates.way).tolist():
        label = np.zeros(candidates.size, dtype=np.int32)
        for number in np.flatnonzero(candidates.way == way).tolist():
            label.ravel()[candidates.cells[number]] = number + 1
        strands = Strands(label=label, surplus=surplus, log_radius=log_radius)
        masks += masks_of(strands, ones, picture.ignore.shape[:2], least_score=0.0)
    return masks


def taught(
    examples: Examples,
    steps: int,
    init: Scorer | None = None,
    progress: Progress = lambda name, done, total: None,
) -> Scorer:
    """Return a scorer fitted to examples; from `init` on, or from random weights.

    Without examples it is `init`, or says one half of everything. One that never saw any example
    learns as a new one does.
    """
    torch.manual_seed(_SEED)
    scorer = Scorer(examples.strips.shape[1] - BESIDE) if init is None else copy.deepcopy(init)
    if not len(examples.overlap):
        return scorer.eval()
    known_well = bool(scorer.seen)
    if not known_well:
        _standardise(scorer, examples)
    peak = _GENTLE_RATE if known_well else _PEAK_RATE
    for number in range(len(scorer.judges)):
        _teach(scorer, number, examples, steps, peak, progress)
    return scorer.eval()


def _teach(
    scorer: Scorer, number: int, examples: Examples, steps: int, peak: float, progress: Progress
) -> None:
    """Fit one judge of a scorer to examples, in place; the others do not count."""
    rng = np.random.default_rng(number)
    torch.manual_seed(number)
    judge = scorer.judges[number].train()
    before, total = number * steps, len(scorer.judges) * steps
    wanted = np.clip((examples.overlap - LEAST_OVERLAP) / (2 * _SOFT) + 0.5, 0.0, 1.0)
    optimiser = torch.optim.AdamW(judge.parameters(), lr=peak, weight_decay=_DECAY)
    rate = torch.optim.lr_scheduler.OneCycleLR(optimiser, peak, total_steps=steps)
    fast = has_fast_bfloat16()
    for step in range(steps):
        chosen = rng.integers(len(wanted), size=_BATCH)
        strips = torch.from_numpy(examples.strips[chosen].astype(np.float32))
        along, across = (rng.random(2) < 0.5).tolist()
        with torch.autocast("cpu", torch.bfloat16, enabled=fast):
            logits = judge(scorer.standardised(mirrored(strips, along=along, across=across)))
        target = torch.from_numpy(wanted[chosen].astype(np.float32))
        loss = binary_cross_entropy_with_logits(logits, target)
        optimiser.zero_grad(set_to_none=True)
        loss.backward()  # type: ignore[no-untyped-call]  # torch leaves it untyped
        optimiser.step()
        rate.step()
        if (step + 1) % _TOLD_EVERY == 0 or step + 1 == steps:
            progress("scorer", before + step + 1, total)


def _standardise(scorer: Scorer, examples: Examples) -> None:
    rng = np.random.default_rng(_SEED)
    some = rng.choice(len(examples.strips), min(len(examples.strips), _SEEN), replace=False)
    seen = examples.strips[np.sort(some)].astype(np.float32)
    scorer.middle.copy_(torch.from_numpy(seen.mean(axis=(0, 2, 3))))
    scorer.spread.copy_(torch.from_numpy(seen.std(axis=(0, 2, 3)) + 1e-3))
    scorer.seen.fill_(1.0)
