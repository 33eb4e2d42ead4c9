"""Training images for a branch segmenter, as a COCO data set.

Every fragment a network should find is an annotation with polygons; wood too small for that is
one `iscrowd` region per image, to be ignored. Trees, leaves, light and camera are drawn anew.
"""

import json
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from canopy_skel.frame import UInt8Array
from canopy_skel.geometry import BoolArray, FloatArray, transform_from
from mock_hw.orchard.camera import Camera, Shot, shoot
from mock_hw.orchard.foliage import MOST_LEAVES
from mock_hw.orchard.light import any_weather
from mock_hw.orchard.path import look_at
from mock_hw.orchard.presets import SPECIES
from mock_hw.orchard.scene import Scene, build_scene
from mock_hw.orchard.tree import TRUNK_X_M, grow

FRAMES_PER_SCENE = 4
BRANCH = 1
_JPEG_QUALITY = 95


@dataclass(frozen=True, kw_only=True, eq=False, slots=True)
class Frame:
    """One training image: color_rgb (H, W, 3), the instance masks, their scores, what to ignore."""

    color_rgb: UInt8Array
    masks: list[BoolArray]
    scores: tuple[float, ...]
    ignore: BoolArray


def training_frames(count: int, *, seed: int, camera: Camera | None = None) -> Iterator[Frame]:
    """Yield training images; the same seed and camera give the same images."""
    lens = replace(camera or Camera(), depth=False, pair=False)
    scene: Scene | None = None
    for index in range(count):
        if scene is None or index % FRAMES_PER_SCENE == 0:
            scene = _any_scene(np.random.default_rng([seed, index, 8]))
        pose = _any_pose(np.random.default_rng([seed, index, 9]))
        yield _frame(shoot(scene, pose, lens, index=index, stamp_ns=0, seed=seed))


def export_coco(
    directory: Path, count: int, *, seed: int, camera: Camera | None = None
) -> dict[str, object]:
    """Write `images/*.jpg` and `annotations.json` under a directory; return the annotations."""
    (directory / "images").mkdir(parents=True, exist_ok=True)
    images: list[dict[str, object]] = []
    annotations: list[dict[str, object]] = []
    for index, frame in enumerate(training_frames(count, seed=seed, camera=camera)):
        name = f"images/{index:06d}.jpg"
        height, width = frame.color_rgb.shape[:2]
        data = cv2.imencode(
            ".jpg", frame.color_rgb[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY]
        )[1]
        (directory / name).write_bytes(bytes(data))
        images.append({"id": index, "file_name": name, "width": width, "height": height})
        for annotation in _annotations(frame):
            annotations.append({"id": len(annotations) + 1, "image_id": index, **annotation})
    document: dict[str, object] = {
        "info": {"description": "synthetic orchard", "seed": seed},
        "categories": [{"id": BRANCH, "name": "branch"}],
        "images": images,
        "annotations": annotations,
    }
    (directory / "annotations.json").write_text(json.dumps(document))
    return document


def _any_scene(rng: np.random.Generator) -> Scene:
    species = SPECIES[str(rng.choice(sorted(SPECIES)))]
    leaves = int(MOST_LEAVES[species.name] * 0.7 * rng.random() ** 2)
    return build_scene(
        grow(species, int(rng.integers(1 << 31))),
        leaves,
        any_weather(rng),
        seed=int(rng.integers(1 << 31)),
        rows=bool(rng.random() < 0.8),
        trellis=bool(rng.random() < 0.5),
    )


def _any_pose(rng: np.random.Generator) -> FloatArray:
    """Draw a camera 0.35 to 1.6 m before a point of the crown, upright or turned."""
    target = np.array([TRUNK_X_M, 0.0, 0.05]) + rng.normal(0, [0.1, 0.25, 0.3])
    bearing, climb = rng.uniform(-0.7, 0.7), rng.uniform(-0.45, 0.45)
    ahead = np.array([np.cos(bearing) * np.cos(climb), np.sin(bearing), np.sin(climb)])
    pose = look_at(target - rng.uniform(0.35, 1.6) * ahead, target)
    roll = rng.uniform(-np.pi, np.pi) if rng.random() < 0.3 else rng.normal(0, 0.08)
    c, s = np.cos(roll), np.sin(roll)
    turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    return pose @ transform_from(turn, [0.0, 0.0, 0.0])


def _frame(shot: Shot) -> Frame:
    instances, scores = shot.view.instances, shot.view.scores
    if instances is None or scores is None:
        raise ValueError("the camera labels every view")
    return Frame(
        color_rgb=shot.view.color_rgb,
        masks=[instances == number for number in range(1, len(scores) + 1)],
        scores=scores,
        ignore=(shot.fragments.label >= 0) & (instances == 0),
    )


def _annotations(frame: Frame) -> Iterator[dict[str, object]]:
    for mask, score in zip(frame.masks, frame.scores, strict=True):
        polygons = _polygons(mask)
        if polygons:
            shape = {"segmentation": polygons, "iscrowd": 0, "score": score}
            yield {"category_id": BRANCH, **shape, **_extent(mask)}
    if frame.ignore.any():
        counts = {"size": list(frame.ignore.shape), "counts": run_lengths(frame.ignore)}
        yield {
            "category_id": BRANCH,
            "segmentation": counts,
            "iscrowd": 1,
            **_extent(frame.ignore),
        }


def _extent(mask: BoolArray) -> dict[str, object]:
    v, u = np.nonzero(mask)
    left, top = int(u.min()), int(v.min())
    box = [left, top, int(u.max()) - left + 1, int(v.max()) - top + 1]
    return {"bbox": box, "area": int(mask.sum())}


def _polygons(mask: BoolArray) -> list[list[float]]:
    """Return the outlines of a mask as flat lists x, y, x, y, … of at least three corners.

    Corners of pixels are whole numbers, as in COCO; the outline runs a quarter of a pixel inside.
    """
    fine = np.kron(mask, np.ones((2, 2), dtype=np.uint8)).astype(np.uint8)
    found = cv2.findContours(fine, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
    outlines = [(contour.reshape(-1, 2) + 0.5) / 2 for contour in found[0]]
    return [outline.ravel().tolist() for outline in outlines if len(outline) >= 3]


def run_lengths(mask: BoolArray) -> list[int]:
    """Return COCO's uncompressed run lengths: column by column, starting with zeros."""
    flat = mask.ravel(order="F")
    turns = np.flatnonzero(np.diff(flat)) + 1
    lengths = np.diff(np.concatenate([[0], turns, [flat.size]])).tolist()
    return [0, *lengths] if flat[0] else lengths
