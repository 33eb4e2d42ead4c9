import json

import cv2
import numpy as np
import pytest

from mock_hw.orchard.camera import Camera
from mock_hw.orchard.coco import export_coco, run_lengths, training_frames


@pytest.fixture(scope="module")
def camera(small):
    return Camera(intrinsics=small)


def test_run_lengths_decode_to_the_mask(rng):
    for first in (False, True):
        mask = rng.random((17, 23)) < 0.4
        mask[0, 0] = first
        values = np.arange(len(run_lengths(mask))) % 2 == 1
        assert np.array_equal(np.repeat(values, run_lengths(mask)), mask.ravel(order="F"))


def test_a_data_set_describes_its_images(tmp_path, camera, small):
    export_coco(tmp_path, 5, seed=3, camera=camera)
    document = json.loads((tmp_path / "annotations.json").read_text())
    frames = list(training_frames(5, seed=3, camera=camera))
    assert [image["id"] for image in document["images"]] == [0, 1, 2, 3, 4]
    assert len({a["id"] for a in document["annotations"]}) == len(document["annotations"])
    assert len(document["annotations"]) > 10
    for image, frame in zip(document["images"], frames, strict=True):
        picture = cv2.imread(str(tmp_path / image["file_name"]))
        assert picture.shape == (image["height"], image["width"], 3)
        assert np.abs(picture[..., ::-1].astype(int) - frame.color_rgb).mean() < 6
        own = [a for a in document["annotations"] if a["image_id"] == image["id"]]
        masks = [a for a in own if not a["iscrowd"]]
        assert len(masks) == len(frame.masks)
        for annotation, mask in zip(masks, frame.masks, strict=True):
            canvas = np.zeros(mask.shape, np.uint8)
            for polygon in annotation["segmentation"]:
                cv2.fillPoly(canvas, [np.array(polygon, int).reshape(-1, 1, 2)], 1)
            assert (canvas[mask] == 1).all()
            left, top, width, height = annotation["bbox"]
            assert canvas[top : top + height, left : left + width].sum() == canvas.sum()
            assert annotation["area"] == mask.sum()
        for crowd in (a for a in own if a["iscrowd"]):
            runs = crowd["segmentation"]["counts"]
            assert sum(runs) == small.width_px * small.height_px
            assert sum(runs[1::2]) == crowd["area"] == frame.ignore.sum()


def test_training_images_are_repeatable_and_varied(camera):
    first, second = (list(training_frames(3, seed=1, camera=camera)) for _ in range(2))
    for a, b in zip(first, second, strict=True):
        assert a.color_rgb.tobytes() == b.color_rgb.tobytes()
    assert first[0].color_rgb.tobytes() != first[1].color_rgb.tobytes()
    other = next(training_frames(1, seed=2, camera=camera))
    assert first[0].color_rgb.tobytes() != other.color_rgb.tobytes()
