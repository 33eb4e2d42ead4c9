"""The data of the built-in weights: a training set, and a validation set of another kind."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from canopy_skel.segmenters.labels import LabelledImage
from mock_hw.orchard.composed.frames import FRAMES_PER_SCENE, Variety, scene_frames
from mock_hw.orchard.presets import APPLE, OAK, WALNUT
from service.training.store import StoredImages, store

TRAIN = Variety(seed=20260101, species=(APPLE, OAK), clutter=1.6)
VALIDATE = Variety(seed=20260102, species=(WALNUT,), strange=True)


@dataclass(frozen=True, kw_only=True, slots=True)
class Amounts:
    """How many scenes (of four pictures each) are drawn."""

    train_scenes: int = 220
    validate_scenes: int = 60


def draw(folder: Path, amounts: Amounts, progress: Callable[[str, int, int], None]) -> None:
    """Draw what is still missing of both sets into `folder`/train and `folder`/validate.

    Raises:
        UsageError: a folder cannot be written, or another version has drawn into it.
    """
    for name, variety, scenes in (
        ("validate", VALIDATE, amounts.validate_scenes),
        ("train", TRAIN, amounts.train_scenes),
    ):
        drawn = StoredImages(folder / name)
        if len(drawn):
            drawn.maps(0)
        for scene in range(scenes):
            last = folder / name / f"{scene:05d}-{FRAMES_PER_SCENE - 1}.labels.npz"
            if not last.exists():
                store(folder / name, _named(variety, scene))
            progress(name, scene + 1, scenes)


def _named(variety: Variety, scene: int) -> Iterator[tuple[str, LabelledImage]]:
    for index, image in enumerate(scene_frames(variety, scene)):
        yield f"{scene:05d}-{index}", image
