"""Pictures that users labelled: every tool's annotation means the pixels that its user saw."""

import base64
import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from canopy_skel.errors import UsageError
from service.training.coco import read_coco
from service.training.labelme import read_labelme
from service.training.run_lengths import decoded
from service.training.shapes import Shape
from service.training.user_pictures import UserPictures, labelled, scan_of, split

SIZE = (120, 160)
BAR = [[20, 10], [30, 10], [30, 100], [20, 100]]
ACROSS = [[60, 50], [150, 50], [150, 56], [60, 56]]


def encoded(mask):
    """Compressed run lengths as the COCO API writes them: the decoder's plain inverse."""
    flat = mask.ravel(order="F").astype(int)
    lengths = np.diff(np.flatnonzero(np.diff(flat, prepend=1 - flat[0], append=1 - flat[-1])))
    lengths = [0, *lengths.tolist()] if flat[0] else lengths.tolist()
    text = ""
    for place, length in enumerate(lengths):
        value, more = length - lengths[place - 2] if place > 2 else length, True
        while more:
            group = value & 0x1F
            value >>= 5
            more = value != (-1 if group & 0x10 else 0)
            text += chr((group | 0x20 if more else group) + 48)
    return text


@given(st.integers(1, 40), st.integers(1, 40), st.floats(0, 1), st.integers(0, 1 << 20))
def test_compressed_run_lengths_come_back(height, width, share, seed):
    mask = np.random.default_rng(seed).random((height, width)) < share
    assert np.array_equal(decoded(encoded(mask), height, width), mask)


def test_what_the_coco_api_writes_is_read():
    mask = np.zeros((40, 60), bool)
    mask[10:30, 20:24] = True
    mask[5, :] = True
    assert np.array_equal(decoded(COCO_API, 40, 60), mask)


COCO_API = "51W1" + "0" * 39 + "mNc0;]OEc0;]OEc0;]OEc0;]Oh" + "0" * 70 + "K"


@pytest.mark.parametrize("counts", ["5", "o", "\x7f", "é", [3, -1, 10], [1.5, 10.5], "1" * 99, ""])
def test_run_lengths_that_are_none_are_refused(counts):
    with pytest.raises(ValueError, match=r"run lengths"):
        decoded(counts, 3, 4)


@pytest.fixture
def folder(tmp_path):
    """A function that writes pictures and a COCO file of them."""

    def write(annotations, names=("a_0.png",), categories=("branch",), **changes):
        for name in names:
            (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
            cv2.imwrite(str(tmp_path / name), np.full((*SIZE, 3), 90, np.uint8))
        document = {
            "images": [
                {"id": k, "file_name": name, "height": SIZE[0], "width": SIZE[1]}
                for k, name in enumerate(names)
            ],
            "categories": [{"id": k, "name": name} for k, name in enumerate(categories)],
            "annotations": [
                {"id": 10 + k, "image_id": 0, "category_id": 0, **one}
                for k, one in enumerate(annotations)
            ],
        }
        (tmp_path / "ann.json").write_text(json.dumps(document | changes))
        return tmp_path / "ann.json"

    return write


def polygon(points, **fields):
    return {"segmentation": [np.ravel(points).tolist()], **fields}


def first(path, branch=()):
    pictures, _ = read_coco(path, path.parent, branch)
    return labelled(pictures[0])


def test_a_polygon_is_the_pixels_inside_it(folder):
    image = first(folder([polygon(BAR), polygon(ACROSS)])).image
    expected = np.zeros(SIZE, int)
    expected[10:100, 20:30], expected[50:56, 60:150] = 1, 2
    assert np.array_equal(image.instances, expected)
    (upright, across) = image.lines
    assert upright[:, 0] == pytest.approx(24.5)
    assert sorted(upright[[0, -1], 1]) == pytest.approx([10, 99])
    assert across[:, 2] == pytest.approx(3.0, rel=0.1)
    assert not image.ignore.any()
    assert image.color_rgb.shape == (*SIZE, 3)


def test_polygons_and_run_lengths_of_a_mask_are_the_same_instance(folder):
    mask = np.zeros(SIZE, bool)
    mask[10:100, 20:30] = True
    plain = [10 + 20 * SIZE[0]]
    plain += [90, 30] * 9 + [90]
    plain += [SIZE[0] * SIZE[1] - sum(plain)]
    for counts in (encoded(mask), plain):
        runs = {"segmentation": {"size": list(SIZE), "counts": counts}}
        assert np.array_equal(first(folder([runs])).image.instances > 0, mask)


def test_a_bent_branch_becomes_straight_pieces_and_is_named(folder):
    bent = [[20, 10], [28, 10], [28, 92], [110, 92], [110, 100], [20, 100]]
    result = first(folder([polygon(bent), polygon([[60, 20], [150, 20], [150, 26], [60, 26]])]))
    assert result.bent == ("annotation 10",)
    assert len(result.image.lines) == result.image.instances.max() >= 3
    for line in result.image.lines[1:]:
        turn = np.degrees(np.arctan2(*np.abs(line[-1] - line[0])[:2]))
        assert min(turn, 90 - turn) < 30


def test_parts_that_a_leaf_divides_are_instances_and_specks_are_ignored(folder):
    parts = [
        [20, 10, 30, 10, 30, 50, 20, 50],
        [20, 60, 30, 60, 30, 99, 20, 99],
        [50, 50, 53, 50, 53, 53],
    ]
    result = first(folder([{"segmentation": parts}]))
    assert len(result.image.lines) == 2
    assert 3 <= result.image.ignore.sum() <= 9
    assert result.bent == ()


@pytest.mark.parametrize(
    "nothing",
    [
        {"segmentation": [[5.0, 5.0] * 3]},
        {"segmentation": {"size": list(SIZE), "counts": [SIZE[0] * SIZE[1]]}},
        {"bbox": [5, 5, 0, 0]},
    ],
)
def test_a_shape_that_covers_no_pixel_is_nothing(folder, nothing):
    image = first(folder([nothing, polygon(BAR)])).image
    assert len(image.lines) == 1
    assert not image.ignore.any()


def test_a_line_wider_than_the_picture_is_refused(labelme):
    line = {"points": [[10, 10], [90, 10]], "shape_type": "linestrip", "description": "99999"}
    (picture,), _ = read_labelme(labelme([line]))
    with pytest.raises(UsageError, match=r"a_0\.png: shape 1 has a width of 99999 pixels, more"):
        labelled(picture)


def test_the_smaller_of_two_that_overlap_is_in_front(folder):
    twig = [[5, 40], [120, 40], [120, 44], [5, 44]]
    for order in (1, -1):
        image = first(folder([polygon(BAR), polygon(twig)][::order])).image
        assert (image.instances[40:44, 5:120] == image.instances[42, 100]).all()


def test_what_is_no_slender_piece_is_named(folder):
    assert first(folder([polygon([[20, 20], [90, 20], [90, 80], [20, 80]])])).stout == (
        "annotation 10",
    )


def test_crowds_ignored_categories_and_bare_boxes_are_ignored(folder):
    path = folder(
        [
            polygon(BAR),
            polygon(ACROSS, iscrowd=1),
            polygon([[60, 80], [80, 80], [80, 90], [60, 90]], category_id=1),
            {"bbox": [100, 100, 10, 5]},
            polygon([[60, 5], [80, 5], [80, 15], [60, 15]], category_id=2),
        ],
        categories=("branch", "ignore", "leaf"),
    )
    pictures, notes = read_coco(path, path.parent)
    image = labelled(pictures[0]).image
    expected = np.zeros(SIZE, bool)
    expected[50:56, 60:150] = expected[80:90, 60:80] = expected[100:105, 100:110] = True
    assert np.array_equal(image.ignore, expected)
    assert len(image.lines) == 1
    assert notes == [f"{path}: 1 annotations are boxes without outline and ignored"]


def test_which_category_is_a_branch_can_be_chosen(folder):
    path = folder(
        [polygon(BAR), polygon(ACROSS, category_id=1)], categories=("trunk", "limb", "leaf")
    )
    assert len(first(path, ["trunk", "limb"]).image.lines) == 2
    assert len(first(path, ["limb"]).image.lines) == 1
    with pytest.raises(UsageError, match=r"which categories are branches\? It has trunk, limb, le"):
        read_coco(path, path.parent)
    with pytest.raises(UsageError, match="has no category 'twig'; it has trunk, limb, leaf"):
        read_coco(path, path.parent, ["twig"])


@pytest.mark.parametrize(
    ("annotations", "changes", "says"),
    [
        ([{"bbox": [1, 2, 3, 4]}], {}, "its 1 annotations have no outline .* label branches with"),
        ([], {}, "its 0 annotations have no outline"),
        ([{}, polygon(BAR)], {}, "annotation 10 has neither an outline nor a box"),
        ([polygon(BAR, category_id=7)], {}, "annotation 10 has category_id 7, which the file does"),
        ([polygon(BAR, image_id=7)], {}, "annotation 10 has image_id 7, which the file does not"),
        ([polygon(BAR, category_id=None)], {}, "annotation 10 has category_id None"),
        ([polygon(BAR)], {"images": None}, "has no list of images; export it anew"),
        ([polygon(BAR)], {"images": [5]}, "not all images are objects"),
        ([polygon(BAR)], {"images": [{"id": 0}]}, "image 0 has file_name None"),
        ([polygon(BAR)], {"images": [{"id": 0, "file_name": "a_0.png"}]}, "width and height"),
        ([polygon(BAR)], {"images": [{"id": 0}] * 2}, "an image has id 0 as another one has"),
        ([polygon(BAR[:2])], {}, "annotation 10 has a polygon that is none"),
        ([{"segmentation": [["x", 1, 2, 3, 4, 5]]}], {}, "annotation 10 has a polygon that is"),
        ([{"segmentation": {"counts": 5}}], {}, "annotation 10 has run lengths that are none"),
        (
            [{"segmentation": {"counts": "5"}}],
            {},
            r"annotation 10 has run lengths of 5 pixels, not .* \(160x120\); correct",
        ),
        ([polygon([[900, 1], [990, 1], [990, 9]])], {}, "annotation 10 has coordinates far outs"),
        ([polygon([[200, 1], [290, 1], [290, 9]])], {}, "annotation 10 lies outside the picture"),
        ([polygon([[float("nan"), 1], [9, 1], [9, 9]])], {}, "annotation 10 has coordinates far"),
    ],
)
def test_a_bad_coco_file_is_refused_in_one_line_that_names_what(folder, annotations, changes, says):
    path = folder(annotations, **changes)
    with pytest.raises(UsageError, match=says) as refused:
        UserPictures(read_coco(path, path.parent)[0])[0]
    assert "\n" not in str(refused.value)


def test_missing_and_other_pictures_are_refused(folder, tmp_path):
    path = folder([polygon(BAR)])
    with pytest.raises(UsageError, match=r"nowhere/a_0\.png: is not there, but ann\.json has lab"):
        read_coco(path, tmp_path / "nowhere")
    cv2.imwrite(str(tmp_path / "a_0.png"), np.zeros((30, 40, 3), np.uint8))
    with pytest.raises(UsageError, match="is 40x30 but was labelled as 160x120; give the very pic"):
        first(path)
    (tmp_path / "a_0.png").write_bytes(b"no picture")
    with pytest.raises(UsageError, match=r"a_0\.png: is no picture that can be read \(10 bytes\)"):
        first(path)
    for content, says in ((b"{", "is not JSON"), (b"[]", "has no list of images, annotations")):
        path.write_bytes(content)
        with pytest.raises(UsageError, match=says):
            read_coco(path, tmp_path)
    with pytest.raises(UsageError, match="cannot be read"):
        read_coco(tmp_path / "none.json", tmp_path)


def test_the_synthetic_orchards_own_coco_files_are_read_to_the_pixel(tmp_path):
    from mock_hw.orchard.coco import TrainingSet, export_coco
    from mock_hw.orchard.composed.frames import FRAMES_PER_SCENE, scene_frames

    data = TrainingSet(seed=3, picture_scale=0.3, software="test")
    list(export_coco(tmp_path, FRAMES_PER_SCENE + 1, data))
    pictures, _ = read_coco(tmp_path / "annotations.json", tmp_path)
    assert [picture.scan for picture in pictures] == ["0"] * FRAMES_PER_SCENE + ["1"]
    for picture, frame in zip(pictures, scene_frames(data.variety(), 0), strict=False):
        image = labelled(picture).image
        wood = frame.instances > 0
        found = image.instances > 0
        assert not (found & ~wood).any()
        assert (found | image.ignore)[wood].all()
        assert (image.ignore | found | ~frame.ignore).all()


@pytest.fixture
def labelme(tmp_path):
    """A function that writes a LabelMe file."""

    def write(shapes, name="a_0", folder=tmp_path, **changes):
        folder.mkdir(exist_ok=True)
        cv2.imwrite(str(folder / f"{name}.png"), np.full((*SIZE, 3), 90, np.uint8))
        document = {
            "version": "5.5.0",
            "imagePath": f"{name}.png",
            "imageData": None,
            "imageHeight": SIZE[0],
            "imageWidth": SIZE[1],
            "shapes": [{"label": "branch", "shape_type": "polygon", **one} for one in shapes],
        }
        (folder / f"{name}.json").write_text(json.dumps(document | changes))
        return folder

    return write


def test_polygons_and_lines_with_a_width_are_branches(labelme):
    shapes = [
        {"points": BAR},
        {
            "points": [[60, 53], [100, 53], [150, 53]],
            "shape_type": "linestrip",
            "description": "width=6",
        },
        {"points": [[60, 80], [80, 80], [80, 90], [60, 90]], "label": "ignore"},
    ]
    (picture,), _ = read_labelme(labelme(shapes))
    image = labelled(picture).image
    _, across = image.lines
    assert across[:, 1] == pytest.approx(52.5, abs=0.51)
    assert across[:, 2] == pytest.approx(3.0, abs=0.6)
    assert (image.instances == 1).sum() == 900
    assert image.ignore.sum() == 200


def test_a_picture_within_the_file_is_used_where_its_own_is_gone(labelme):
    folder = labelme([{"points": BAR}])
    picture = (folder / "a_0.png").read_bytes()
    (folder / "a_0.png").unlink()
    with pytest.raises(UsageError, match=r"a_0\.json: its picture 'a_0\.png' is not there and not"):
        read_labelme(folder)
    data = base64.b64encode(picture).decode()
    labelme([{"points": BAR}], imageData=data)
    (folder / "a_0.png").unlink()
    (found,), _ = read_labelme(folder)
    assert labelled(found).image.instances.max() == 1
    labelme([{"points": BAR}], imageData="???")
    (folder / "a_0.png").unlink()
    with pytest.raises(UsageError, match="its embedded picture is damaged"):
        read_labelme(folder)


@pytest.mark.parametrize(
    ("shape", "says"),
    [
        ({"points": BAR, "shape_type": "circle"}, "shape 1 is a circle; draw branches as polygons"),
        ({"points": BAR[:2]}, "shape 1 has 2 points; a polygon needs 3"),
        ({"points": "none"}, "shape 1 has points that are none"),
        ({"points": BAR, "shape_type": "linestrip"}, 'shape 1 is a linestrip without .*"width=12"'),
        ({"points": BAR, "label": "leaf"}, None),
        ({"points": BAR, "label": ["branch"]}, None),
        ({"points": BAR, "label": None}, None),
    ],
)
def test_a_bad_labelme_file_is_refused_in_one_line(labelme, shape, says):
    folder = labelme([shape, {"points": ACROSS}])
    if says is None:
        assert len(UserPictures(read_labelme(folder)[0])[0].lines) == 1
        return
    with pytest.raises(UsageError, match=says) as refused:
        read_labelme(folder)
    assert "\n" not in str(refused.value)
    assert "a_0.json" in str(refused.value)


def test_a_folder_without_labels_is_refused(labelme, tmp_path):
    with pytest.raises(UsageError, match="holds no LabelMe file"):
        read_labelme(tmp_path)
    with pytest.raises(UsageError, match="is not a folder"):
        read_labelme(tmp_path / "none")
    folder = labelme([{"points": BAR, "label": "limb"}, {"points": ACROSS, "label": "leaf"}])
    with pytest.raises(UsageError, match="which labels are branches"):
        read_labelme(folder)
    with pytest.raises(UsageError, match="nothing is labelled 'twig'"):
        read_labelme(folder, ["twig"])
    assert len(read_labelme(folder, ["limb"])[0]) == 1


@pytest.mark.parametrize(
    ("name", "scan_id", "scan"),
    [
        ("north/row3_tree2_0007.jpg", None, "north/row3_tree2"),
        ("north/000007.jpg", None, "north"),
        ("tree2-frame-12.png", None, "tree2"),
        ("tree2-frame-12.png", "s9", "s9"),
        ("a.png", 4, "4"),
        ("0001.jpg", None, "."),
    ],
)
def test_a_pictures_scan_is_what_it_says_or_its_folder_and_name(name, scan_id, scan):
    assert scan_of(name, scan_id) == scan


@given(st.lists(st.integers(0, 6), min_size=1, max_size=40))
def test_no_scan_is_on_both_sides(scans):
    from service.training.user_pictures import UserPicture

    pictures = [
        UserPicture(path=Path(str(k)), size=SIZE, scan=str(scan), branches=(), ignored=())
        for k, scan in enumerate(scans)
    ]
    train, validate = split(pictures)
    assert not {one.scan for one in train} & {one.scan for one in validate}
    assert sorted(map(id, train + validate)) == sorted(map(id, pictures))
    assert bool(validate) is (len(set(scans)) > 1)
    assert train
    again = split(pictures[::-1])
    assert {one.scan for one in again[1]} == {one.scan for one in validate}


@given(
    st.floats(50, 70), st.floats(50, 70), st.floats(0, np.pi), st.floats(12, 80), st.floats(1, 6)
)
def test_a_strip_covers_its_area_around_its_middle(v, u, angle, length, radius):
    along = np.array([np.cos(angle), np.sin(angle)])
    across = radius * np.array([-along[1], along[0]])
    a, b = [u, v] - length / 2 * along, [u, v] + length / 2 * along
    corners = np.array([a + across, b + across, b - across, a - across])
    region = Shape(name="strip", outlines=(corners,)).region(SIZE)
    assert region.mask.sum() == pytest.approx(2 * radius * length, abs=length + 2 * radius)
    rows, columns = np.nonzero(region.mask)
    middle = np.array([columns.mean() + region.left, rows.mean() + region.top]) + 0.5
    assert abs((middle - [u, v]) @ across) < 0.6 * radius
    # Of a row or diagonal that the edge runs along, one end may be covered and the other not.
    assert abs((middle - [u, v]) @ along) < 1.5 + length / (8 * radius)
