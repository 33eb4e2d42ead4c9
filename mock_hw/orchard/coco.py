"""Training images for a branch segmenter, as a COCO data set.

The pictures are those the built-in weights are trained on (`composed`), of a seed of your own.
Every fragment a network should find is an annotation with polygons and a score, how sure a good
detector would be of it; wood too small for that is one `iscrowd` region per image, to be ignored.
Each image has a label file of its own, so that the work can be stopped and gone on with;
`annotations.json` is put together at the end.
"""

import json
from collections.abc import Iterable, Iterator
from dataclasses import asdict, dataclass
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from canopy_skel.errors import RecordingError, UsageError
from canopy_skel.segmenters.labels import LabelledImage
from mock_hw.orchard.camera import Camera, scaled
from mock_hw.orchard.composed.frames import FRAMES_PER_SCENE, Variety, scene_frames
from mock_hw.orchard.files import write_whole
from mock_hw.orchard.instances import clarity
from mock_hw.orchard.outlines import box, polygons, run_lengths
from mock_hw.orchard.presets import species_named
from mock_hw.orchard.workers import alone_in, require_jobs, workers

BRANCH = 1
ANNOTATIONS = "annotations.json"
_JPEG_QUALITY = 95


@dataclass(frozen=True, kw_only=True, slots=True)
class TrainingSet:
    """What the images of a folder have in common: image k follows from these and k alone."""

    seed: int = 0
    species: tuple[str, ...] = ("apple", "oak", "walnut")
    picture_scale: float = 1.0
    software: str = ""

    def fields(self) -> dict[str, Any]:
        """Return the fields as they come back from JSON."""
        return {**asdict(self), "species": list(self.species)}

    def variety(self) -> Variety:
        """Return what the pictures are drawn from.

        Raises:
            UsageError: a species is unknown, or the scale leaves no picture.
        """
        lens = scaled(Camera(), self.picture_scale).intrinsics
        return Variety(
            seed=self.seed,
            species=tuple(species_named(name) for name in self.species),
            width_px=lens.width_px,
            height_px=lens.height_px,
        )


def export_coco(folder: Path, count: int, images: TrainingSet, *, jobs: int = 1) -> Iterator[int]:
    """Write a data set; yield how many of its images are there, again and again.

    Images that are there already are kept, so that a data set can be finished, or made larger.

    Args:
        folder: gets `images/`, `labels/` and, at the end, `annotations.json`; it must be there.
        count: how many images.
        images: what they show.
        jobs: how many processes.

    Raises:
        UsageError: an option is out of range, or the folder holds another data set.
        RecordingError: something cannot be written.
    """
    require_jobs(jobs)
    _require_possible(count, images)
    with alone_in(folder):
        for name in ("images", "labels"):
            _make_folder(folder / name)
        missing = _missing(folder, count, images)
        scenes = sorted({index // FRAMES_PER_SCENE for index in missing})
        done = count - len(missing)
        yield done
        with workers(jobs) as pool:
            make = partial(_make_scene, folder=folder, images=images, wanted=frozenset(missing))
            for made in pool.map(make, scenes):
                done += made
                yield done
        _put_together(folder, count, images)


def _require_possible(count: int, images: TrainingSet) -> None:
    if count < 1:
        raise UsageError(f"{count} images; give 1 or more")
    if images.seed < 0:
        raise UsageError(f"seed is {images.seed}; give 0 or more")
    images.variety()


def _make_folder(folder: Path) -> None:
    try:
        folder.mkdir(exist_ok=True)
    except OSError as error:
        raise RecordingError(
            f"{folder}: cannot be made ({error.strerror}); check the disk"
        ) from error


def _missing(folder: Path, count: int, images: TrainingSet) -> list[int]:
    """Return which images are still to be made; a label is written after its image."""
    missing = []
    for index in range(count):
        path = _label_path(folder, index)
        if not (path.exists() and _image_path(folder, index).exists()):
            missing.append(index)
        elif _read_label(path)["set"] != images.fields():
            raise UsageError(
                f"{path}: belongs to a data set with other options; choose another folder"
            )
    return missing


def _make_scene(number: int, *, folder: Path, images: TrainingSet, wanted: frozenset[int]) -> int:
    """Write the missing images of a scene and their labels, in a worker; return how many."""
    made = 0
    frames = scene_frames(images.variety(), number)
    for index, frame in enumerate(frames, start=number * FRAMES_PER_SCENE):
        if index in wanted:
            quality = [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY]
            picture = cv2.imencode(".jpg", frame.color_rgb[..., ::-1], quality)[1]
            write_whole(_image_path(folder, index), [picture.tobytes()])
            label = {"set": images.fields(), **label_of(frame, index)}
            write_whole(_label_path(folder, index), [json.dumps(label).encode()])
            made += 1
    return made


def label_of(frame: LabelledImage, index: int) -> dict[str, Any]:
    """Return the COCO entries of an image: `image`, and `annotations` without their own ids.

    Pictures of one tree have the same `scan_id`, by which data sets are split.
    """
    height, width = frame.color_rgb.shape[:2]
    image = {
        "id": index,
        "file_name": f"images/{_name(index)}.jpg",
        "width": width,
        "height": height,
        "scan_id": index // FRAMES_PER_SCENE,
    }
    return {"image": image, "annotations": list(_annotations(frame, index))}


def _annotations(frame: LabelledImage, index: int) -> Iterator[dict[str, Any]]:
    for number, line in enumerate(frame.lines, start=1):
        mask = frame.instances == number
        pixels = int(mask.sum())
        length_px = float(np.linalg.norm(np.diff(line[:, :2], axis=0), axis=1).sum())
        yield {
            "image_id": index,
            "category_id": BRANCH,
            "segmentation": polygons(mask),
            "area": pixels,
            "bbox": box(mask),
            "score": round(float(np.clip(clarity(pixels, pixels / length_px), 0.5, 0.99)), 3),
            "iscrowd": 0,
        }
    if frame.ignore.any():
        counts = {"size": list(frame.ignore.shape), "counts": run_lengths(frame.ignore)}
        yield {
            "image_id": index,
            "category_id": BRANCH,
            "segmentation": counts,
            "area": int(frame.ignore.sum()),
            "bbox": box(frame.ignore),
            "iscrowd": 1,
        }


def _put_together(folder: Path, count: int, images: TrainingSet) -> None:
    """Write `annotations.json` from the label files, one at a time."""
    labels = [_label_path(folder, index) for index in range(count)]
    pictures = (_read_label(path)["image"] for path in labels)
    annotations = (one for path in labels for one in _read_label(path)["annotations"])
    numbered = ({"id": number, **one} for number, one in enumerate(annotations, start=1))
    info = {"description": "canopy: synthetic orchard", **images.fields()}
    head = {"info": info, "categories": [{"id": BRANCH, "name": "branch"}]}
    document = chain(
        [json.dumps(head)[:-1], ', "images": [\n'],
        _lines(pictures),
        ['], "annotations": [\n'],
        _lines(numbered),
        ["]}\n"],
    )
    write_whole(folder / ANNOTATIONS, (text.encode() for text in document))


def _lines(entries: Iterable[dict[str, Any]]) -> Iterator[str]:
    comma = ""
    for entry in entries:
        yield f"{comma}{json.dumps(entry)}\n"
        comma = ","


def _read_label(path: Path) -> dict[str, Any]:
    try:
        label: dict[str, Any] = json.loads(path.read_bytes())
        if not {"set", "image", "annotations"} <= label.keys():
            raise ValueError
    except (ValueError, AttributeError) as error:
        raise UsageError(f"{path}: is no label of an image; choose another folder") from error
    return label


def _name(index: int) -> str:
    return f"{index:06d}"


def _image_path(folder: Path, index: int) -> Path:
    return folder / "images" / f"{_name(index)}.jpg"


def _label_path(folder: Path, index: int) -> Path:
    return folder / "labels" / f"{_name(index)}.json"
