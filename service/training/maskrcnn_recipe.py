"""The recipe for the paper's Mask R-CNN on a user's labels."""

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch

from canopy_skel.segmenters.maskrcnn.network import SIZE_PX, build, pretrained
from canopy_skel.segmenters.maskrcnn.segmenter import MaskRcnnSegmenter
from canopy_skel.segmenters.maskrcnn.weights import Detector, load, save
from service.evaluation import evaluate
from service.training.maskrcnn import MaskRcnnPlan, train_maskrcnn
from service.training.scoring import Progress
from service.training.store import StoredImages
from service.training.user_pictures import UserPicture
from service.training.user_recipe import Imported, import_pictures


def initial(path: Path | None, size_px: tuple[int, int] = SIZE_PX) -> Detector:
    """Return a detector with random weights, our own, or those of a torchvision checkpoint.

    Raises:
        UsageError: the weights are unusable, or torchvision is not installed.
    """
    if path is None:
        return Detector(network=build("group", size_px), norm="group", size_px=size_px)
    if path.with_suffix(".json").exists():
        return load(path)
    network = pretrained(path, size_px)
    return Detector(network=network, norm="frozen_batch", size_px=size_px)


def maskrcnn_weights(
    folder: Path,
    output: Path,
    pictures: Sequence[UserPicture],
    plan: MaskRcnnPlan,
    detector: Detector,
    progress: Progress,
    device: str = "cpu",
) -> tuple[Imported, dict[str, Any]]:
    """Train a detector on a user's pictures and write it; return what was read and what came of it.

    Raises:
        UsageError: labels are unusable, or a folder cannot be written.
    """
    imported = import_pictures(folder / "data", pictures, progress)
    images = StoredImages(folder / "data" / "train")
    validate = StoredImages(folder / "data" / "validate")

    def show(step: int, loss: float) -> None:
        progress(f"train (loss {loss:.2f})", step, plan.steps)

    steps = train_maskrcnn(detector.network, images, plan, detector.size_px, show, device)
    judged = [validate[k] for k in range(len(validate))]
    scores, _ = evaluate(judged, MaskRcnnSegmenter(detector), detector.least_score)
    facts = {
        "validation": {
            "kind": "the user's pictures of scans not trained on",
            "reported": {k: v for k, v in scores.to_dict().items() if v is not None},
        },
        "training": {
            "plan": asdict(plan),
            "steps": steps,
            "pictures": len(images),
            "scans": imported.scans,
            "torch": torch.__version__,
        },
    }
    save(output, detector, facts)
    return imported, facts
