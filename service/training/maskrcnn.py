"""Training of the paper's Mask R-CNN: 2000 iterations, from scratch or from a checkpoint."""

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import cv2
import numpy as np
import torch
from torch import Tensor

from canopy_skel.errors import UsageError
from canopy_skel.segmenters.labels import LabelledImage, LabelledImages

if TYPE_CHECKING:
    from torchvision.models.detection import MaskRCNN

_FLIPPED = 0.5


@dataclass(frozen=True, kw_only=True, slots=True)
class MaskRcnnPlan:
    """What a training run does: it ends after `steps`, or after `minutes` if that is earlier."""

    steps: int = 2000
    minutes: float = float("inf")
    seed: int = 1
    batch: int = 2
    rate: float = 0.005
    momentum: float = 0.9
    weight_decay: float = 1e-4
    warm_up: int = 100
    gradient_norm: float = 10.0


def train_maskrcnn(
    network: "MaskRCNN",
    images: LabelledImages,
    plan: MaskRcnnPlan,
    size_px: tuple[int, int],
    progress: Callable[[int, float], None],
    device: str = "cpu",
) -> int:
    """Train in place; return the number of steps made.

    Ignored pixels are painted over with the mean colour of the picture, as the network has no
    other way not to be blamed for them. progress: called with each step and its loss.

    Raises:
        UsageError: there are no pictures, or the loss is no number any more.
    """
    if not len(images):
        raise UsageError("there are no pictures to train on; label some first")
    torch.manual_seed(plan.seed)
    parameters = [one for one in network.parameters() if one.requires_grad]
    optimiser = torch.optim.SGD(
        parameters, plan.rate, momentum=plan.momentum, weight_decay=plan.weight_decay
    )
    network.to(device).train()
    start = time.perf_counter()
    step = 0
    while step < plan.steps and time.perf_counter() - start < 60 * plan.minutes:
        for group in optimiser.param_groups:
            group["lr"] = _rate(plan, step)
        rng = np.random.default_rng([plan.seed, step])
        chosen = rng.integers(len(images), size=plan.batch).tolist()
        pairs = [_example(images[k], size_px, flip=rng.random() < _FLIPPED) for k in chosen]
        losses = network(
            [picture.to(device) for picture, _ in pairs],
            [{name: value.to(device) for name, value in target.items()} for _, target in pairs],
        )
        total = torch.stack(list(losses.values())).sum()
        if not torch.isfinite(total):
            raise UsageError(f"training diverged at step {step}; give a smaller rate")
        optimiser.zero_grad(set_to_none=True)
        total.backward()  # type: ignore[no-untyped-call]  # torch leaves it untyped
        torch.nn.utils.clip_grad_norm_(parameters, plan.gradient_norm)
        optimiser.step()
        step += 1
        progress(step, float(total.detach()))
    network.eval()
    return step


def _rate(plan: MaskRcnnPlan, step: int) -> float:
    """Return the learning rate: rising at first, a tenth in the last third."""
    warm = min((step + 1) / plan.warm_up, 1.0)
    return plan.rate * warm * (0.1 if step >= plan.steps * 2 / 3 else 1.0)


def _example(
    image: LabelledImage, size_px: tuple[int, int], *, flip: bool
) -> tuple[Tensor, dict[str, Tensor]]:
    """Return a picture (3, H, W) and its boxes, labels and masks, no larger than `size_px`."""
    color = image.color_rgb.copy()
    color[image.ignore & (image.instances == 0)] = color.mean(axis=(0, 1)).astype(np.uint8)
    instances = image.instances
    scale = min(max(size_px) / max(color.shape[:2]), min(size_px) / min(color.shape[:2]), 1.0)
    if scale < 1:
        size = round(color.shape[1] * scale), round(color.shape[0] * scale)
        color = np.asarray(cv2.resize(color, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)
        instances = np.asarray(
            cv2.resize(instances, size, interpolation=cv2.INTER_NEAREST), dtype=np.uint16
        )
    if flip:
        color, instances = color[:, ::-1], instances[:, ::-1]
    picture = torch.from_numpy(np.ascontiguousarray(color)).permute(2, 0, 1).float() / 255.0
    return picture, _target(np.ascontiguousarray(instances))


def _target(instances: np.ndarray) -> dict[str, Tensor]:
    boxes, masks = [], []
    for number in np.unique(instances[instances > 0]).tolist():
        mask = instances == number
        rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
        boxes.append([columns[0], rows[0], columns[-1] + 1, rows[-1] + 1])
        masks.append(mask)
    height, width = instances.shape
    stacked = np.array(masks, dtype=np.uint8).reshape(-1, height, width)
    return {
        "boxes": torch.tensor(np.array(boxes, dtype=np.float32).reshape(-1, 4)),
        "labels": torch.ones(len(boxes), dtype=torch.int64),
        "masks": torch.from_numpy(stacked),
    }
