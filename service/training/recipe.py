"""The recipe of the built-in weights: draw, train, choose, calibrate, describe."""

import hashlib
import json
import platform
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import accumulate, pairwise
from pathlib import Path
from typing import Any

import torch

from canopy_skel.errors import UsageError
from canopy_skel.segmenters.labels import LabelledImage, without_small
from canopy_skel.segmenters.unet.grouping import Grouping
from canopy_skel.segmenters.unet.network import UNet
from canopy_skel.segmenters.unet.segmenter import UNetSegmenter
from canopy_skel.segmenters.unet.weights import UNCALIBRATED, Model, save
from service.training import builtin
from service.training.judging import Sighting, calibrated, figures, rescored, sight, threshold
from service.training.look import Look
from service.training.loop import Plan, Run, resume, start, train
from service.training.store import StoredImages

WANTED_PRECISION = 0.88
_CANDIDATES = 3
BUILTIN_PLANS = (
    Plan(steps=8400, look_every=300, centre_weight=0.5),
    Plan(steps=7500, look_every=300, seed=2, peak_rate=1.5e-3),
)
"""One after the other: the second goes on from the averaged weights of the first."""
ZOOM = 1.25
"""Networks see pictures this much enlarged: the same weights find a tenth more (docs/unet.md)."""

Progress = Callable[[str, int, int], None]


@dataclass(frozen=True, kw_only=True, eq=False, slots=True)
class Halves:
    """A validation set in two: one to choose and calibrate on, one to report."""

    choose: Sequence[LabelledImage]
    report: Sequence[LabelledImage]


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
    model, facts = finish(runs[-1], folder / f"run{len(runs)}", halves_of(validate))
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
    """Return plans that together take so many steps, or so long; None: as they are."""
    total = sum(plan.steps for plan in plans)
    if steps is not None:
        ends = [round(steps * done / total) for done in accumulate(plan.steps for plan in plans)]
        lengths = [max(end - begin, 1) for begin, end in pairwise([0, *ends])]
        plans = [replace(plan, steps=own) for plan, own in zip(plans, lengths, strict=True)]
        total = sum(lengths)
    if minutes is not None:
        plans = [replace(plan, minutes=minutes * plan.steps / total) for plan in plans]
    return tuple(plans)


def finish(run: Run, folder: Path, halves: Halves) -> tuple[Model, dict[str, Any]]:
    """Choose among the averages that looked best by line-AP, calibrate, and measure.

    Raises:
        UsageError: the folder holds no averaged weights.
    """
    paths = _promising(folder)
    candidates = [(path, *_candidate(path, run.plan, halves.choose)) for path in paths]
    chosen_path, model, chosen = max(candidates, key=lambda c: _line_ap(c[2]))
    calibration = calibrated(chosen)
    least = threshold(rescored(chosen, calibration), WANTED_PRECISION)
    model = replace(model, calibration=calibration, least_score=least)
    facts = {
        "validation": {
            "kind": "synthetic, of a species, bark and backgrounds no training picture has",
            "chosen_on": _figures(_again(model, halves.choose)),
            "reported": _figures(_again(model, halves.report)),
        },
        "training": {
            "plan": run.plan.fields(),
            "steps": run.step,
            "chosen": chosen_path.name,
            "minutes": round(run.seconds / 60, 1),
            "torch": torch.__version__,
            "machine": platform.processor() or platform.machine(),
        },
    }
    return model, facts


def _promising(folder: Path) -> list[Path]:
    """Return the averages that looked best during training."""
    try:
        log = [json.loads(line) for line in (folder / "log.jsonl").read_text().splitlines()]
    except OSError as error:
        raise UsageError(f"{folder}: holds no training log; train first") from error
    best = sorted(log, key=lambda entry: -float(entry["val_iou"]))[:_CANDIDATES]
    return [folder / f"average-{entry['step']:06d}.pt" for entry in best]


def _candidate(
    path: Path, plan: Plan, images: Sequence[LabelledImage]
) -> tuple[Model, list[Sighting]]:
    network = UNet(plan.channels)
    network.load_state_dict(torch.load(path, weights_only=True))
    model = Model(
        network=network.eval(),
        channels=plan.channels,
        zoom=ZOOM,
        grouping=Grouping(),
        calibration=UNCALIBRATED,
        least_score=0.0,
    )
    return model, _again(model, images)


def _again(model: Model, images: Sequence[LabelledImage]) -> list[Sighting]:
    segmenter = UNetSegmenter(model)
    return [
        sight(
            segmenter.maps(image.color_rgb),
            image,
            model.grouping,
            model.calibration,
            model.least_score,
        )
        for image in images
    ]


def _line_ap(sightings: Sequence[Sighting]) -> float:
    return figures(rescored(sightings, calibrated(sightings))).line_ap or 0.0


def _figures(sightings: Sequence[Sighting]) -> dict[str, float | int | None]:
    values = figures(sightings).to_dict()
    return {name: None if value is None else round(value, 4) for name, value in values.items()}


def digest(images: StoredImages) -> str:
    """Return a SHA-256 over all pictures and target maps, which says what was trained on."""
    total = hashlib.sha256()
    for k, name in enumerate(images.names):
        total.update(name.encode())
        total.update(images.color(k).tobytes())
        total.update(images.maps(k).tobytes())
    return total.hexdigest()
