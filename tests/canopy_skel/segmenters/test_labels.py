import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scenes.drawn import cover, drawn, polyline, straight

from canopy_skel.segmenters.labels import labelled_image, line_of_mask
from canopy_skel.segmenters.unet.targets import (
    ANGLE,
    ANGLE_STEPS,
    CENTRE,
    RADIUS,
    RADIUS_PX,
    STATE,
    Target,
    targets_of,
)


def angle_apart_deg(a, b):
    return abs((a - b + 90) % 180 - 90)


@given(angle=st.floats(0, 180), length=st.floats(60, 180), radius=st.floats(2.5, 9))
def test_the_middle_line_of_a_bar_is_its_axis(angle, length, radius):
    line = straight((160, 120), angle, length, radius)
    found = line_of_mask(cover(line, (240, 320)))
    step = found[-1, :2] - found[0, :2]
    assert angle_apart_deg(np.degrees(np.arctan2(step[1], step[0])), angle) < 3
    assert np.linalg.norm(step) == pytest.approx(length, abs=5)
    assert found[:, 2].mean() == pytest.approx(radius, abs=1.0)
    along = np.radians(angle)
    across = (found[:, :2] - (160, 120)) @ (-np.sin(along), np.cos(along))
    assert np.abs(across).max() < 1.5


def test_masks_alone_make_a_labelled_picture():
    lines = [straight((80, 60), 20, 90, 4), straight((200, 160), 110, 120, 7)]
    image = drawn(lines)
    masks = [image.instances == 1, image.instances == 2]
    again = labelled_image(image.color_rgb, masks, image.ignore)
    assert np.array_equal(again.instances, image.instances)
    for line, found in zip(lines, again.lines, strict=True):
        assert np.linalg.norm(found[:, :2].mean(axis=0) - line[:, :2].mean(axis=0)) < 2


@given(angle=st.floats(0, 179.9), radius=st.floats(3, 20))
def test_targets_say_where_branches_are_how_they_run_and_how_thick(angle, radius):
    image = drawn([straight((160, 120), angle, 150, radius)])
    maps = targets_of(image)
    wood = maps[..., STATE] == Target.BRANCH
    assert wood.sum() == pytest.approx((image.instances > 0).sum() / 4, rel=0.2)
    degrees = maps[..., ANGLE][wood] * (180 / ANGLE_STEPS)
    assert angle_apart_deg(degrees, angle).max() < 1.0
    low, high = np.log(RADIUS_PX)
    found = np.exp(maps[..., RADIUS][wood] / 255 * (high - low) + low)
    assert np.abs(found / radius - 1).max() < 0.03
    middle = maps[..., CENTRE] == 1
    assert middle[wood].mean() == pytest.approx(max(0.35, 1.5 / radius), abs=0.2)
    assert not (middle & ~wood).any()


def test_what_is_to_be_ignored_is_no_branch_and_no_background():
    image = drawn([straight((160, 60), 0, 150, 6)])
    image.ignore[150:170, 40:200] = True
    maps = targets_of(image)
    assert (maps[75:85, 20:100, STATE] == Target.IGNORE).all()
    assert (maps[..., STATE] == Target.IGNORE).sum() == 10 * 80
    assert (maps[..., STATE] == Target.BRANCH).any()


def test_a_picture_without_branches_has_only_background():
    image = drawn([])
    assert not targets_of(image).any()


def test_the_direction_follows_a_bend():
    image = drawn([polyline([(60, 60), (160, 60), (160, 200)], 5)])
    maps = targets_of(image)
    degrees = maps[..., ANGLE] * (180 / ANGLE_STEPS)
    assert degrees[30, 50] == pytest.approx(0, abs=1)
    assert degrees[80, 80] == pytest.approx(90, abs=1)
