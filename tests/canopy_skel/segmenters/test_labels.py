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
    PIECE,
    RADIUS,
    RADIUS_PX,
    STATE,
    STRIDE,
    Target,
    places_of,
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


def test_cells_say_which_piece_they_are_of():
    image = drawn([straight((80, 60), 20, 90, 4), straight((200, 160), 110, 120, 7)])
    maps = targets_of(image)
    assert np.array_equal(maps[..., PIECE] > 0, maps[..., STATE] == Target.BRANCH)
    assert maps[30, 40, PIECE] == 1
    assert maps[80, 100, PIECE] == 2


def test_numbers_of_pieces_begin_again_after_255():
    corners = [(u, v) for v in range(8, 240, 16) for u in range(8, 320, 16)]
    maps = targets_of(drawn([straight(corner, 0, 10, 3) for corner in corners]))
    numbers = [maps[v // 2, u // 2, PIECE] for u, v in corners]
    assert numbers == [*range(1, 256), *range(1, len(corners) - 254)]


def on_strip(maps, angle):
    """Of the cells of a strip: how far along it, and the way to its middle along and across."""
    v, u = np.nonzero(maps[..., PIECE])
    middle_u, middle_v, log_length = places_of(maps)[v, u].T
    cosine, sine = np.cos(np.radians(angle)), np.sin(np.radians(angle))
    way = cosine * middle_u + sine * middle_v
    return cosine * u + sine * v, way, cosine * middle_v - sine * middle_u, np.exp(log_length)


@given(
    angle=st.floats(0, 180),
    length=st.floats(60, 180),
    radius=st.floats(3, 9),
    kept=st.floats(0.3, 1),
)
def test_cells_of_a_strip_say_where_its_middle_is_and_how_long_it_is(angle, length, radius, kept):
    maps = targets_of(drawn([straight((160, 120), angle, length, radius)]))
    along, way, across, found = on_strip(maps, angle)
    cell = 2 * STRIDE / length
    assert found == pytest.approx(length, abs=2 * STRIDE)
    middle = (np.cos(np.radians(angle)) * 160 + np.sin(np.radians(angle)) * 120) / STRIDE
    assert way == pytest.approx((middle - along) * cell, abs=1.5 * cell)
    assert np.abs(across).max() < 0.03
    assert [way.max(), way.min()] == pytest.approx([1, -1], abs=cell)

    # What a crop leaves of it is a piece of its own.
    v, u = np.nonzero(maps[..., PIECE])
    if np.ptp(u) > np.ptp(v):
        crop = maps[:, : u.min() + int(kept * np.ptp(u)) + 1]
    else:
        crop = maps[v.max() - int(kept * np.ptp(v)) :]
    along, way, _, found = on_strip(crop, angle)
    seen = np.ptp(along) + 1
    assert found == pytest.approx(STRIDE * seen, rel=0.02)
    assert way == pytest.approx((along.min() + along.max() - 2 * along) / seen, abs=0.03)


def test_each_of_two_pieces_has_a_middle_of_its_own():
    one, other = straight((80, 60), 20, 90, 4), straight((200, 160), 110, 120, 7)
    both = places_of(targets_of(drawn([one, other])))
    apart = [places_of(targets_of(drawn([line]))) for line in (one, other)]
    assert both == pytest.approx(apart[0] + apart[1])


def test_without_branches_nothing_has_a_place():
    assert not places_of(targets_of(drawn([]))).any()
