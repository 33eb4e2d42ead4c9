import contextlib
import io
import json
from dataclasses import replace

import cv2
import numpy as np
import pytest
from pycocotools.coco import COCO

from canopy_skel.errors import RecordingError, UsageError
from mock_hw.orchard.coco import TrainingSet, export_coco
from mock_hw.orchard.composed.frames import FRAMES_PER_SCENE, scene_frames

# pycocotools 2.0 is older than numpy 2.
pytestmark = pytest.mark.filterwarnings("ignore:__array__ implementation:DeprecationWarning")
COUNT = FRAMES_PER_SCENE + 1
IMAGES = TrainingSet(seed=3, picture_scale=0.4, software="test")


@pytest.fixture(scope="module")
def frames():
    both = (scene_frames(IMAGES.variety(), number) for number in (0, 1))
    return [frame for scene in both for frame in scene][:COUNT]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("coco")
    assert list(export_coco(path, COUNT, IMAGES, jobs=2))[-1] == COUNT
    return path


@pytest.fixture(scope="module")
def coco(folder):
    with contextlib.redirect_stdout(io.StringIO()):
        return COCO(str(folder / "annotations.json"))


def contents(folder):
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in folder.rglob("*")
        if path.is_file()
    }


def test_what_shows_more_has_a_higher_score(coco):
    pieces = coco.loadAnns(coco.getAnnIds(iscrowd=False))
    pieces.sort(key=lambda piece: piece["area"])
    assert 0.5 <= pieces[0]["score"] < pieces[-1]["score"] <= 0.99


def test_a_coco_reader_finds_every_instance_to_the_pixel(coco, frames):
    assert coco.getCatIds(catNms=["branch"]) == [1]
    assert sorted(coco.getImgIds()) == list(range(COUNT))
    assert sum(len(frame.lines) for frame in frames) > 20
    for index, frame in enumerate(frames):
        pieces = coco.loadAnns(coco.getAnnIds(index, iscrowd=False))
        assert len(pieces) == len(frame.lines)
        for number, piece in enumerate(pieces, start=1):
            mask = frame.instances == number
            found = coco.annToMask(piece).astype(bool)
            assert np.array_equal(found, mask)
            assert piece["area"] == mask.sum()
            left, top, width, height = piece["bbox"]
            assert mask[top : top + height, left : left + width].sum() == mask.sum()
            assert mask[top].any()
            assert mask[:, left].any()


def test_what_is_too_small_to_be_found_is_to_be_ignored(coco, frames):
    assert any(frame.ignore.any() for frame in frames)
    for index, frame in enumerate(frames):
        crowds = coco.loadAnns(coco.getAnnIds(index, iscrowd=True))
        assert len(crowds) == int(frame.ignore.any())
        for crowd in crowds:
            assert np.array_equal(coco.annToMask(crowd).astype(bool), frame.ignore)
            assert crowd["area"] == frame.ignore.sum()


def test_images_are_the_pictures_and_say_which_tree_they_show(folder, coco, frames):
    images = coco.loadImgs(range(COUNT))
    for image, frame in zip(images, frames, strict=True):
        picture = cv2.imread(str(folder / image["file_name"]))
        assert picture.shape == (image["height"], image["width"], 3)
        assert np.abs(picture[..., ::-1].astype(int) - frame.color_rgb).mean() < 6
    assert [image["scan_id"] for image in images] == [0] * FRAMES_PER_SCENE + [1]
    assert frames[0].color_rgb.tobytes() != frames[1].color_rgb.tobytes()


def test_a_data_set_is_finished_and_made_larger_with_the_same_bytes(folder, tmp_path):
    steps = list(export_coco(tmp_path, COUNT - 1, IMAGES))
    assert steps[0] == 0
    (tmp_path / "labels" / "000002.json").unlink()
    (tmp_path / "images" / "000001.jpg").unlink()
    steps = list(export_coco(tmp_path, COUNT, IMAGES))
    assert (steps[0], steps[-1]) == (COUNT - 3, COUNT)
    assert contents(tmp_path) == contents(folder)


def test_another_data_set_in_the_folder_is_not_touched(folder):
    before = contents(folder)
    with pytest.raises(UsageError, match=r"000000.json: belongs to a data set with other options"):
        list(export_coco(folder, COUNT, replace(IMAGES, seed=4)))
    assert contents(folder) == before


@pytest.mark.parametrize(
    ("count", "change", "jobs", "message"),
    [
        (0, {}, 1, "0 images; give 1 or more"),
        (1, {}, 0, "jobs is 0; give 1 or more"),
        (1, {"species": ("pear",)}, 1, "unknown species 'pear'"),
        (1, {"seed": -1}, 1, "seed is -1; give 0 or more"),
        (1, {"picture_scale": 0.0}, 1, "no pictures scaled by 0.0"),
    ],
)
def test_impossible_data_sets_are_refused_before_any_work(tmp_path, count, change, jobs, message):
    with pytest.raises(UsageError, match=message):
        list(export_coco(tmp_path, count, replace(IMAGES, **change), jobs=jobs))
    assert not list(tmp_path.iterdir())


def test_a_label_that_is_none_is_named(folder, tmp_path):
    for name, data in contents(folder).items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_bytes(data)
    (tmp_path / "labels" / "000001.json").write_text(json.dumps({"image": {}}))
    with pytest.raises(UsageError, match=r"000001.json: is no label of an image"):
        list(export_coco(tmp_path, COUNT, IMAGES))


def test_a_folder_that_cannot_be_made_is_named(tmp_path):
    (tmp_path / "images").write_text("in the way")
    with pytest.raises(RecordingError, match=r"images: cannot be made \(File exists\)"):
        list(export_coco(tmp_path, 1, IMAGES))
