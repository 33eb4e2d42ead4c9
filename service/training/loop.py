"""The training loop: batches in, checkpoints and a log out; it may be stopped and resumed."""

import json
import math
import os
import pickle
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.optim import AdamW

from canopy_skel.errors import UsageError
from canopy_skel.segmenters.unet.loss import loss_of
from canopy_skel.segmenters.unet.network import CHANNELS, UNet, channels_last, maps_of, normalised
from canopy_skel.segmenters.unet.precision import has_fast_bfloat16
from service.training.crops import draw_batch
from service.training.store import StoredImages


@dataclass(frozen=True, kw_only=True, slots=True)
class Plan:
    """What a training run does.

    It ends after `steps` batches or after `minutes`, whichever comes first; the learning rate
    falls as a cosine over that span. centre_weight: of the middle line's part of the loss.
    piece_weight: of where in its piece a cell lies, and how long that is. look_every: steps between
    validations and checkpoints. data: a digest of the labels and the weights a user began with, so
    that a run is not gone on with on others.
    """

    steps: int
    minutes: float = float("inf")
    seed: int = 1
    batch: int = 8
    crop_px: int = 320
    peak_rate: float = 2e-3
    weight_decay: float = 1e-2
    warm_up: int = 100
    average: float = 0.999
    gradient_norm: float = 5.0
    centre_weight: float = 1.0
    piece_weight: float = 1.0
    look_every: int = 250
    channels: tuple[int, ...] = CHANNELS
    data: str = ""

    def fields(self) -> dict[str, Any]:
        """Return the plan, ready for JSON: without `minutes` where there is no limit."""
        values = asdict(self)
        return values if math.isfinite(self.minutes) else {**values, "minutes": None}


@dataclass(kw_only=True, slots=True)
class Run:
    """A run under way: network, its moving average, optimiser, steps and seconds so far."""

    plan: Plan
    network: UNet
    averaged: UNet
    optimiser: AdamW
    step: int = 0
    seconds: float = 0.0
    losses: dict[str, float] = field(default_factory=dict)

    @property
    def progress(self) -> float:
        """Return how much of the plan is done, 0 to 1."""
        return min(max(self.step / self.plan.steps, self.seconds / (60 * self.plan.minutes)), 1.0)


def start(plan: Plan, init: dict[str, Tensor] | None = None) -> Run:
    """Return a run at its first step, from random weights or from given ones."""
    torch.manual_seed(plan.seed)
    network = channels_last(UNet(plan.channels))
    if init is not None:
        network.load_state_dict(init)
    averaged = UNet(plan.channels)
    averaged.load_state_dict(network.state_dict())
    optimiser = AdamW(network.parameters(), lr=plan.peak_rate, weight_decay=plan.weight_decay)
    return Run(plan=plan, network=network, averaged=averaged, optimiser=optimiser)


def train(
    run: Run,
    images: Callable[[], StoredImages],
    folder: Path,
    look: Callable[[UNet], dict[str, float]],
) -> None:
    """Train to the end of the plan.

    images: asked again at each look. look: judges the averaged network. `folder` gets
    `checkpoint.pt` (to resume from), `average-<step>.pt` and a line in `log.jsonl` at each look.

    Raises:
        UsageError: there are no pictures to train on, or another version stored them.
    """
    folder.mkdir(parents=True, exist_ok=True)
    torch.set_num_threads(1)  # a second one brings next to nothing, and the core is wanted
    fast = has_fast_bfloat16()
    while run.progress < 1.0:
        pictures = images()
        if not len(pictures):
            raise UsageError("there are no pictures to train on; draw or import some first")
        end = run.step - run.step % run.plan.look_every + run.plan.look_every
        before = run.seconds, run.step
        while run.step < end and run.progress < 1.0:
            _advance(run, pictures, fast=fast)
        pace = (run.step - before[1]) / max(run.seconds - before[0], 1e-9)
        run.averaged.eval()
        entry = {
            "step": run.step,
            "minutes": round(run.seconds / 60, 2),
            "rate": run.optimiser.param_groups[0]["lr"],
            "pictures": len(pictures),
            "crops_per_second": round(pace * run.plan.batch, 2),
            **{name: round(value, 4) for name, value in run.losses.items()},
            **{name: round(value, 4) for name, value in look(run.averaged).items()},
        }
        save(run, folder)
        with (folder / "log.jsonl").open("a") as log:
            log.write(json.dumps(entry) + "\n")


def _advance(run: Run, pictures: StoredImages, *, fast: bool) -> None:
    """Take one step; the batch depends on nothing but seed and step."""
    clock = time.perf_counter()
    plan = run.plan
    for group in run.optimiser.param_groups:
        group["lr"] = _rate(run)
    rng = np.random.default_rng([plan.seed, run.step])
    batch = draw_batch(pictures, rng, count=plan.batch, size_px=plan.crop_px)
    run.network.train()
    with torch.autocast("cpu", torch.bfloat16, enabled=fast):
        output = run.network(normalised(batch.color_rgb))
    loss = loss_of(maps_of(output), torch.from_numpy(batch.maps), torch.from_numpy(batch.places))
    total = loss.total(plan.centre_weight, plan.piece_weight)
    run.optimiser.zero_grad(set_to_none=True)
    total.backward()  # type: ignore[no-untyped-call]  # torch leaves it untyped
    torch.nn.utils.clip_grad_norm_(run.network.parameters(), plan.gradient_norm)
    run.optimiser.step()
    run.step += 1
    _average(run)
    for name in ("branch", "centre", "direction", "radius", "middle", "length"):
        value = float(getattr(loss, name).detach())
        run.losses[name] = 0.98 * run.losses.get(name, value) + 0.02 * value
    run.seconds += time.perf_counter() - clock


def _rate(run: Run) -> float:
    warm = min((run.step + 1) / run.plan.warm_up, 1.0)
    return run.plan.peak_rate * warm * max(0.5 * (1 + float(np.cos(np.pi * run.progress))), 0.003)


@torch.no_grad()
def _average(run: Run) -> None:
    keep = min(run.plan.average, (1 + run.step) / (10 + run.step))
    pairs = zip(run.averaged.state_dict().values(), run.network.state_dict().values(), strict=True)
    for mean, value in pairs:
        if mean.dtype.is_floating_point:
            mean.lerp_(value, 1 - keep)
        else:
            mean.copy_(value)


def save(run: Run, folder: Path) -> None:
    """Write the checkpoint, whole or not at all, and the averaged weights beside it."""
    state: dict[str, Any] = {
        "plan": asdict(run.plan),
        "step": run.step,
        "seconds": run.seconds,
        "losses": run.losses,
        "network": run.network.state_dict(),
        "averaged": run.averaged.state_dict(),
        "optimiser": run.optimiser.state_dict(),
    }
    part = folder / "checkpoint.part"
    torch.save(state, part)
    os.replace(part, folder / "checkpoint.pt")
    torch.save(run.averaged.state_dict(), folder / f"average-{run.step:06d}.pt")


def _checkpoint(path: Path) -> dict[str, Any]:
    try:
        state = torch.load(path, weights_only=True)
    except (pickle.UnpicklingError, RuntimeError, EOFError, ValueError, OSError) as error:
        raise UsageError(
            f"{path}: is damaged; remove it to begin anew, or give another folder"
        ) from error
    if not isinstance(state, dict) or "plan" not in state:
        raise UsageError(f"{path}: is no checkpoint of a training; give another folder")
    found: dict[str, Any] = state
    return found


def resume(plan: Plan, folder: Path) -> Run | None:
    """Return the run a folder holds a checkpoint of, None if it holds none.

    Raises:
        UsageError: the checkpoint is of another plan (its length may differ), or damaged.
    """
    path = folder / "checkpoint.pt"
    if not path.exists():
        return None
    state = _checkpoint(path)
    then, now = {"data": "", **state["plan"]}, asdict(plan)
    if then["data"] != now["data"]:
        raise UsageError(
            f"{path}: was trained on other labels, or began with other weights; give another folder"
            " (and go on from what this one holds with --init)"
        )
    for name in now.keys() - {"steps", "minutes", "look_every"}:
        if then.get(name) != now[name]:
            raise UsageError(
                f"{path}: was trained with {name} {then.get(name)}, not {now[name]};"
                " give another folder to start anew"
            )
    run = start(plan)
    run.network.load_state_dict(state["network"])
    run.averaged.load_state_dict(state["averaged"])
    run.optimiser.load_state_dict(state["optimiser"])
    run.step, run.seconds, run.losses = state["step"], state["seconds"], state["losses"]
    return run
