"""The recipe for a user's own labels: go on from the built-in weights, or begin anew."""

import hashlib
import shutil
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from canopy_skel.errors import UsageError
from canopy_skel.segmenters.labels import LabelledImage
from canopy_skel.segmenters.unet.grouping import Grouping
from canopy_skel.segmenters.unet.weights import Model, save
from service.training.look import Look
from service.training.loop import Plan, Run, resume, start, train
from service.training.recipe import ZOOM, Halves, Lessons, finish, with_scorer
from service.training.scoring import Progress
from service.training.store import StoredImages, store
from service.training.user_pictures import UserPicture, labelled, split

FINE_PLAN = Plan(steps=4000, peak_rate=5e-4, look_every=100)
SCRATCH_PLAN = Plan(steps=8000)
ENOUGH_INSTANCES = 60
"""To choose, calibrate and set a threshold on; with fewer, those of the initial weights stay."""
_NAMED = 3


@dataclass(frozen=True, kw_only=True, slots=True)
class Imported:
    """What came of a user's labels: one line for each thing to be aware of."""

    train: int
    validate: int
    scans: int
    warnings: tuple[str, ...]


def import_pictures(folder: Path, pictures: Sequence[UserPicture], progress: Progress) -> Imported:
    """Store labelled pictures in `folder`/train and `folder`/validate, no scan in both.

    Raises:
        UsageError: a picture or its labels are unusable, or the folder cannot be written.
    """
    sets = dict(zip(("train", "validate"), split(pictures), strict=True))
    bent: list[str] = []
    stout: list[str] = []
    for name, own in sets.items():
        shutil.rmtree(folder / name, ignore_errors=True)  # of an earlier run, perhaps split else
        store(folder / name, _named(name, own, bent, stout, progress))
    scans = {picture.scan for picture in pictures}
    warnings = [
        *_told(bent, "are bent and were cut into straight pieces, as the segmenter finds them"),
        *_told(stout, "are not slender; are they whole trees, or leaves?"),
    ]
    if not sets["validate"]:
        warnings.append(
            f"all {len(pictures)} pictures are of one scan ({min(scans)}), so none is left to judge"
            " by; label pictures of other trees too, named SCAN_NUMBER or in a folder for each scan"
        )
    return Imported(
        train=len(sets["train"]),
        validate=len(sets["validate"]),
        scans=len(scans),
        warnings=tuple(warnings),
    )


def _named(
    name: str,
    pictures: Sequence[UserPicture],
    bent: list[str],
    stout: list[str],
    progress: Progress,
) -> Iterator[tuple[str, LabelledImage]]:
    for number, picture in enumerate(pictures):
        result = labelled(picture)
        bent.extend(f"{picture.path.name} {shape}" for shape in result.bent)
        stout.extend(f"{picture.path.name} {shape}" for shape in result.stout)
        progress(f"read {name}", number + 1, len(pictures))
        yield f"{number:05d}", result.image


def _told(shapes: Sequence[str], what: str) -> list[str]:
    some = ", ".join(shapes[:_NAMED]) + (", …" if len(shapes) > _NAMED else "")
    return [f"{len(shapes)} shapes {what} ({some})"] if shapes else []


def user_weights(
    folder: Path,
    output: Path,
    pictures: Sequence[UserPicture],
    plan: Plan,
    init: Model | None,
    progress: Progress,
) -> tuple[Imported, dict[str, Any]]:
    """Train on a user's pictures and write weights; return what was read and what came of it.

    Args:
        folder: for the pictures, checkpoints and the log; a broken-off run is gone on with.
        output: the weights to write.
        pictures: labelled ones.
        plan: how long; its channels are those of `init`.
        init: weights to go on from, random ones if None.
        progress: called with a name, how much is done, and of how much.

    Raises:
        UsageError: labels are unusable, nothing is labelled, or a folder cannot be written.
    """
    imported = import_pictures(folder / "data", pictures, progress)
    train_set = StoredImages(folder / "data" / "train")
    validate = StoredImages(folder / "data" / "validate")
    if not any(len(train_set[k].lines) for k in range(len(train_set))):
        raise UsageError("no branch is labelled in the pictures to train on; label some first")
    if init is not None:
        plan = replace(plan, channels=init.channels)
    state = None if init is None else init.network.state_dict()
    plan = replace(plan, data=_digest(folder / "data" / "train", state))
    run = resume(plan, folder / "run") or start(plan, state)
    shown = validate if len(validate) else train_set
    look = Look(shown, range(min(len(shown), 20)), ZOOM)
    train(run, lambda: train_set, folder / "run", look)
    scorer = None if init is None else init.scorer
    seen = (train_set[k] for k in range(len(train_set)))
    lessons = Lessons(pictures=seen, count=len(train_set), init=scorer, progress=progress)
    judged = [validate[k] for k in range(len(validate))]
    model, facts = _finished(run, folder / "run", lessons, judged, init)
    facts["training"] |= {"pictures": len(train_set), "scans": imported.scans}
    save(output, model, facts)
    return imported, facts


def _digest(labels: Path, state: Mapping[str, Tensor] | None) -> str:
    """Return a SHA-256 over the stored labels and the weights to begin with."""
    total = hashlib.sha256()
    for path in sorted(labels.glob("*.labels.npz")):
        total.update(path.read_bytes())
    for name, value in sorted((state or {}).items()):
        total.update(name.encode() + value.numpy().tobytes())
    return total.hexdigest()


def _finished(
    run: Run,
    folder: Path,
    lessons: Lessons,
    validate: Sequence[LabelledImage],
    init: Model | None,
) -> tuple[Model, dict[str, Any]]:
    """Teach the scorer, calibrate and measure; keep to that of `init` where little is left.

    On the pictures the network has learned by heart nearly every strand is right; without others to
    set it right the scorer would be too sure.
    """
    if sum(len(image.lines) for image in validate) >= ENOUGH_INSTANCES:
        halves = Halves(choose=validate, report=validate)
        model, facts = finish(run, folder, lessons, halves)
        facts["validation"]["kind"] = (
            "the user's pictures of scans not trained on; threshold and calibration were set on"
            " them too, so expect a little less elsewhere"
        )
        return model, facts
    if init is None:
        model = with_scorer(run.averaged, run.step, lessons, ZOOM, Grouping())
        model = replace(model, least_score=0.5)
    else:
        model = replace(init, network=run.averaged.eval())
    kind = "none: too few instances in scans that were not trained on"
    training = {"plan": run.plan.fields(), "steps": run.step, "torch": torch.__version__}
    return model, {"validation": {"kind": kind, "reported": {}}, "training": training}
