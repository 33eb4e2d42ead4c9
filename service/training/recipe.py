"""The recipe of the built-in weights: draw, train, choose, teach the scorer, describe."""

import hashlib
import json
import platform
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import accumulate, pairwise
from math import inf
from pathlib import Path
from typing import Any

import torch

from canopy_skel.errors import UsageError
from canopy_skel.metrics.segmentation import Judgement, segmentation_scores
from canopy_skel.segmenters.labels import LabelledImage, without_small
from canopy_skel.segmenters.unet.grouping import Grouping
from canopy_skel.segmenters.unet.network import UNet
from canopy_skel.segmenters.unet.scorer import Scorer
from canopy_skel.segmenters.unet.weights import Model, save, untaught_scorer
from service.training import builtin
from service.training.judging import (
    corrected,
    corrected_scorer,
    honest,
    judgements_of,
    threshold,
)
from service.training.look import Look
from service.training.loop import Plan, Run, resume, start, train
from service.training.scoring import Progress, examples_of, taught
from service.training.store import StoredImages

WANTED_PRECISION = 0.88
_TAUGHT_STEPS, _FURTHER_STEPS = 6000, 1500
"""The scorer learns so long, anew or on from another; no more steps than the network did."""
_AS_MUCH = 0.01
"""Networks whose overlap with wood differs by less see as much."""
BUILTIN_PLANS = (
    Plan(steps=8400, look_every=300, centre_weight=0.5, piece_weight=0.0),
    Plan(
        steps=7200,
        look_every=300,
        seed=2,
        peak_rate=1.5e-3,
        batch=6,
        crop_px=384,
    ),
)
"""One after the other: the second goes on from the averaged weights of the first.

Only the second learns where in its piece a cell lies; more of a piece shows in its larger crops.
"""
ZOOM = 1.25
"""Networks see pictures this much enlarged: the same weights find a tenth more (docs/unet.md)."""


@dataclass(frozen=True, kw_only=True, eq=False, slots=True)
class Halves:
    """A validation set in two: one to choose and calibrate on, one to report."""

    choose: Sequence[LabelledImage]
    report: Sequence[LabelledImage]


@dataclass(frozen=True, kw_only=True, eq=False, slots=True)
class Lessons:
    """What a scorer learns from: `count` pictures, from the scorer `init` on; None: anew."""

    pictures: Iterable[LabelledImage]
    count: int
    init: Scorer | None
    progress: Progress

    def shown(self) -> Iterator[LabelledImage]:
        """Yield the pictures, telling how many have been."""
        for number, picture in enumerate(self.pictures):
            yield picture
            self.progress("strands", number + 1, self.count)


def choosing(images: StoredImages) -> list[int]:
    """Return the pictures of the first half of the scenes; names start with a scene's number."""
    scenes = [name.split("-")[0] for name in images.names]
    first = set(sorted(set(scenes))[: len(set(scenes)) // 2])
    return [number for number, scene in enumerate(scenes) if scene in first]


def halves_of(images: StoredImages) -> Halves:
    """Split a set by scene, not by picture."""
    first = set(choosing(images))
    halves: tuple[list[LabelledImage], list[LabelledImage]] = ([], [])
    for number in range(len(images)):
        halves[number not in first].append(without_small(images[number]))
    return Halves(choose=halves[0], report=halves[1])


def builtin_weights(
    folder: Path,
    output: Path,
    plans: Sequence[Plan],
    amounts: builtin.Amounts,
    progress: Progress,
) -> dict[str, Any]:
    """Make the built-in weights in `folder`, going on where it was left; return what they are.

    Each of the plans has a folder of its own, `run1` and so on.

    Raises:
        UsageError: a folder cannot be written, or holds a run of another plan.
    """
    builtin.draw(folder / "data", amounts, progress)
    validate = StoredImages(folder / "data" / "validate")
    pictures = StoredImages(folder / "data" / "train")
    look = Look(validate, choosing(validate)[::4], ZOOM)
    runs: list[Run] = []
    for number, plan in enumerate(plans, start=1):
        own = folder / f"run{number}"
        init = runs[-1].averaged.state_dict() if runs else None
        run = resume(plan, own) or start(plan, init)
        runs.append(run)

        def looked(network: UNet, run: Run = run) -> dict[str, float]:
            before = sum(other.step for other in runs[:-1])
            progress("steps", before + run.step, sum(plan.steps for plan in plans))
            return look(network)

        train(run, lambda: pictures, own, looked)
    last = folder / f"run{len(runs)}"
    seen = (without_small(pictures[k]) for k in range(len(pictures)))
    lessons = Lessons(pictures=seen, count=len(pictures), init=None, progress=progress)
    model, facts = finish(runs[-1], last, lessons, halves_of(validate))
    facts["training"] |= {
        "plan": [run.plan.fields() for run in runs],
        "steps": sum(run.step for run in runs),
        "minutes": round(sum(run.seconds for run in runs) / 60, 1),
        "pictures": len(pictures),
        "data": digest(pictures),
    }
    save(output, model, facts)
    return facts


def shortened(plans: Sequence[Plan], steps: int | None, minutes: float | None) -> tuple[Plan, ...]:
    """Return plans that together take so many steps, or so long; None: as they are.

    Either lifts the plans' own limits of time.
    """
    total = sum(plan.steps for plan in plans)
    if steps is not None:
        ends = [round(steps * done / total) for done in accumulate(plan.steps for plan in plans)]
        lengths = [max(end - begin, 1) for begin, end in pairwise([0, *ends])]
        plans = [
            replace(plan, steps=own, minutes=inf) for plan, own in zip(plans, lengths, strict=True)
        ]
        total = sum(lengths)
    if minutes is not None:
        plans = [replace(plan, minutes=minutes * plan.steps / total) for plan in plans]
    return tuple(plans)


def finish(
    run: Run,
    folder: Path,
    lessons: Lessons,
    halves: Halves,
) -> tuple[Model, dict[str, Any]]:
    """Take the averages that looked best, teach the scorer, make it honest, and measure.

    Raises:
        UsageError: the folder holds no averaged weights.
    """
    path = best_of(folder)
    network = UNet(run.plan.channels)
    network.load_state_dict(torch.load(path, weights_only=True))
    model = with_scorer(network, run.step, lessons, ZOOM, Grouping())
    chosen = judgements_of(model, halves.choose)
    correction = honest(chosen)
    least = threshold(corrected(chosen, correction), WANTED_PRECISION)
    scorer = corrected_scorer(model.scorer, correction)
    model = replace(model, scorer=scorer, least_score=least)
    facts = {
        "validation": {
            "kind": "synthetic, of a species, bark and backgrounds no training picture has",
            "chosen_on": _figures(judgements_of(model, halves.choose)),
            "reported": _figures(judgements_of(model, halves.report)),
        },
        "training": {
            "plan": run.plan.fields(),
            "steps": run.step,
            "chosen": path.name,
            "minutes": round(run.seconds / 60, 1),
            "torch": torch.__version__,
            "machine": platform.processor() or platform.machine(),
        },
    }
    return model, facts


def with_scorer(
    network: UNet,
    steps: int,
    lessons: Lessons,
    zoom: float,
    grouping: Grouping,
) -> Model:
    """Return a network that learned for some steps, with a scorer that pictures taught."""
    model = Model(
        network=network.eval(),
        channels=network.channels,
        zoom=zoom,
        grouping=grouping,
        scorer=untaught_scorer(network.channels),
        least_score=0.0,
    )
    most = _TAUGHT_STEPS if lessons.init is None else _FURTHER_STEPS
    examples = examples_of(model, lessons.shown())
    scorer = taught(examples, min(steps, most), lessons.init, lessons.progress)
    return replace(model, scorer=scorer)


def best_of(folder: Path) -> Path:
    """Return the averages that knew best where in its piece a cell lies, of those that see as much.

    The place is what line-AP is lost by; it is measured only where wood is found.
    """
    try:
        log = [json.loads(line) for line in (folder / "log.jsonl").read_text().splitlines()]
    except OSError as error:
        raise UsageError(f"{folder}: holds no training log; train first") from error
    most = max(float(entry["val_iou"]) for entry in log)
    enough = [entry for entry in log if float(entry["val_iou"]) >= most - _AS_MUCH]
    best = min(enough, key=lambda entry: float(entry["val_middle"]))
    return folder / f"average-{best['step']:06d}.pt"


def _figures(judgements: Sequence[Judgement]) -> dict[str, float | int | None]:
    values = segmentation_scores(judgements).to_dict()
    return {name: None if value is None else round(value, 4) for name, value in values.items()}


def digest(images: StoredImages) -> str:
    """Return a SHA-256 over all pictures and target maps, which says what was trained on."""
    total = hashlib.sha256()
    for k, name in enumerate(images.names):
        total.update(name.encode())
        total.update(images.color(k).tobytes())
        total.update(images.maps(k).tobytes())
    return total.hexdigest()
