import numpy as np
import pytest

from mock_hw.orchard import renderer
from mock_hw.orchard.composed import clutter
from mock_hw.orchard.composed.frames import FRAMES_PER_SCENE, Variety, scene_frames
from mock_hw.orchard.composed.labels import LEAST_PIXELS, labels_in
from mock_hw.orchard.mesh import mesh_of_wood
from mock_hw.orchard.path import camera_path
from mock_hw.orchard.presets import WALNUT

SMALL = Variety(seed=5, width_px=320, height_px=240)


@pytest.fixture(scope="module")
def frames():
    return [frame for number in range(2) for frame in scene_frames(SMALL, number)]


def test_the_same_numbers_give_the_same_pictures(frames):
    again = list(scene_frames(SMALL, 1))
    assert len(again) == FRAMES_PER_SCENE
    for a, b in zip(frames[FRAMES_PER_SCENE:], again, strict=True):
        assert np.array_equal(a.color_rgb, b.color_rgb)
        assert np.array_equal(a.instances, b.instances)
        assert all(np.array_equal(x, y) for x, y in zip(a.lines, b.lines, strict=True))


def test_scenes_differ(frames):
    assert not np.array_equal(frames[0].color_rgb, frames[FRAMES_PER_SCENE].color_rgb)


def test_each_instance_is_large_enough_and_near_its_line(frames):
    count = 0
    for frame in frames:
        assert frame.instances.max() == len(frame.lines)
        assert not (frame.ignore & (frame.instances > 0)).any()
        for number, line in enumerate(frame.lines, start=1):
            mask = frame.instances == number
            assert mask.sum() >= LEAST_PIXELS
            v, u = np.nonzero(mask)
            middle = np.array([u.mean(), v.mean()])
            apart = np.linalg.norm(line[:, :2] - middle, axis=1)
            assert apart.min() < 0.7 * np.linalg.norm(line[-1, :2] - line[0, :2])
            count += 1
    assert count >= 8


def test_lines_run_along_the_middle_of_their_masks(frames):
    for frame in frames:
        for number, line in enumerate(frame.lines, start=1):
            v, u = np.nonzero(frame.instances == number)
            apart = np.column_stack([u, v])[:, None] - line[None, :, :2]
            nearest = np.linalg.norm(apart, axis=2).min(axis=1)
            assert np.percentile(nearest, 90) < 1.2 * line[:, 2].max() + 3


def test_a_set_of_another_kind_is_of_its_own_species():
    kind = Variety(seed=6, species=(WALNUT,), strange=True, width_px=160, height_px=120)
    pictures = [frame.color_rgb for frame in scene_frames(kind, 0)]
    assert all(picture.shape == (120, 160, 3) for picture in pictures)


@pytest.fixture
def trunk(apple, small):
    """A view of the trunk and the vertices it shows, nothing before it."""
    pose = camera_path(10)[2]
    picture = renderer.draw(mesh_of_wood(apple), pose, small)
    return picture.vertex, pose


def trunk_instances(vertex, pose, tree, small):
    labels = labels_in(vertex, tree, pose, small)
    order = np.where(vertex >= 0, tree.order[vertex], -1)
    return labels, set(np.unique(labels.instances[(order == 0) & (labels.instances > 0)]))


def test_what_stands_before_wood_takes_its_label_away(apple, trunk, small):
    vertex, pose = trunk
    free, _ = trunk_instances(vertex, pose, apple, small)
    hidden = vertex.copy()
    hidden[:, 150:170] = -1
    labels, _ = trunk_instances(hidden, pose, apple, small)
    assert free.instances[:, 150:170].any()
    assert not labels.instances[:, 150:170].any()
    assert not labels.ignore[:, 150:170].any()


def test_a_wire_before_a_branch_leaves_it_one_and_a_leaf_makes_two(apple, trunk, small):
    vertex, pose = trunk
    _, whole = trunk_instances(vertex, pose, apple, small)
    counts = []
    for width in (4, 30):
        hidden = vertex.copy()
        hidden[100 : 100 + width] = -1
        counts.append(len(trunk_instances(hidden, pose, apple, small)[1]))
    assert counts == [len(whole), len(whole) + 1]


@pytest.mark.parametrize("kind", ["wire", "drip", "stake", "post"])
def test_hardware_crosses_the_picture_and_nothing_else(rng, kind):
    layer = clutter.hardware(rng, (120, 160), kind)
    assert layer.rgb.shape == (120, 160, 3)
    assert np.isfinite(layer.rgb).all()
    assert layer.alpha.min() >= 0
    assert layer.alpha.max() <= 1
    before = rng.random((120, 160, 3)).astype(np.float32)
    after = layer.over(before)
    assert np.array_equal(after[layer.alpha == 0], before[layer.alpha == 0])


def test_backgrounds_are_finite_and_of_the_right_size(rng):
    for _ in range(6):
        for picture in (
            clutter.background(rng, (90, 120), None),
            clutter.strange_background(rng, (90, 120)),
        ):
            assert picture.shape == (90, 120, 3)
            assert np.isfinite(picture).all()
