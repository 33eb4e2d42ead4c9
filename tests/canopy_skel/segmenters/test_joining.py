import tracemalloc

import numpy as np
import pytest

from canopy_skel.segmenters.unet.joining import joined

RULE = np.array([1.0, 0.1, 0.5])
LOG_RADIUS = np.full((60, 120), np.log(2.0), dtype=np.float32)


def path(start, step, count):
    """Cells (row, column) from `start` on by `step`."""
    return (np.array(start) + np.arange(count)[:, None] * np.array(step)).astype(np.int32)


def field_of(paths, log_radius=LOG_RADIUS):
    """Maps of direction and radius that fit the paths."""
    field = np.zeros((3, *log_radius.shape), dtype=np.float32)
    for cells in paths:
        down, right = cells[-1] - cells[0]
        angle = 2 * np.arctan2(down, right)
        field[0, cells[:, 0], cells[:, 1]] = np.cos(angle)
        field[1, cells[:, 0], cells[:, 1]] = np.sin(angle)
    field[2] = log_radius
    return field


def joined_of(paths, log_radius=LOG_RADIUS):
    return joined(paths, field_of(paths, log_radius), RULE)


def cells_of(paths):
    return sorted(len(p) for p in paths)


@pytest.mark.parametrize("gap", [1, 3, 6])
@pytest.mark.parametrize("turned", [False, True])
def test_what_goes_on_straight_is_one(gap, turned):
    first, second = path((30, 10), (0, 1), 30), path((30, 39 + gap), (0, 1), 30)
    (one,) = joined_of([first, second[::-1] if turned else second])
    assert len(one) == 60
    assert np.abs(np.diff(one[:, 1])).max() == gap
    assert {tuple(one[0]), tuple(one[-1])} == {(30, 10), (30, 68 + gap)}


@pytest.mark.parametrize(
    "second",
    [
        path((30, 54), (0, 1), 30),  # too far
        path((36, 41), (0, 1), 30),  # aside
        path((31, 40), (1, 1), 25),  # another direction
        path((28, 20), (0, 1), 30),  # beside, not after
    ],
)
def test_what_does_not_stays_two(second):
    first = path((30, 10), (0, 1), 30)
    assert cells_of(joined_of([first, second])) == cells_of([first, second])


@pytest.mark.parametrize("common", [2, 6, 10])
@pytest.mark.parametrize("turned", [False, True])
def test_where_two_run_side_by_side_one_of_them_is_left_out(common, turned):
    first, second = path((30, 10), (0, 1), 40), path((32, 50 - common), (0, 1), 40)
    (one,) = joined_of([first, second[::-1] if turned else second])
    along = np.sort(one[:, 1])
    assert (along == np.arange(10, 90 - common)).all()


def test_a_hook_that_thinning_leaves_at_an_end_does_not_turn_it():
    hooked = path((30, 10), (0, 1), 30)
    hooked[-4:, 0] += [1, 2, 3, 4]
    second = path((33, 42), (0, 1), 40)
    (one,) = joined_of([hooked, second])
    assert len(one) == 70


def test_at_a_fork_the_straighter_one_goes_on():
    trunk = path((30, 10), (0, 1), 40)
    on, off = path((30, 51), (0, 1), 40), np.array([(31 + k // 4, 51 + k) for k in range(40)])
    found = joined_of([trunk, off.astype(np.int32), on])
    assert cells_of(found) == [40, 80]
    assert {tuple(p[-1]) for p in found} | {tuple(p[0]) for p in found} >= {(30, 10), (30, 90)}


def test_pieces_of_unlike_width_are_not_one():
    log_radius = LOG_RADIUS.copy()
    log_radius[:, 40:] = np.log(6.0)
    pieces = [path((30, 10), (0, 1), 30), path((30, 42), (0, 1), 30)]
    assert len(joined_of(pieces, log_radius)) == 2


def test_many_in_a_row_become_one_and_none_is_lost():
    pieces = [path((30, 5 + 14 * k), (0, 1), 12) for k in range(7)]
    (one,) = joined_of(pieces)
    assert sorted(one[:, 1]) == sorted(np.concatenate(pieces)[:, 1])
    assert joined_of([]) == []


def test_the_thousands_of_pieces_of_a_large_picture_do_not_take_its_memory():
    log_radius = np.full((4000, 40), np.log(1.5), dtype=np.float32)
    column = np.arange(5, 35, dtype=np.int32)
    rows = np.arange(5, 3995, dtype=np.int32)[::3]
    paths = [np.stack([np.full_like(column, row), column], axis=1) for row in rows]
    field = field_of(paths, log_radius)
    tracemalloc.start()
    result = joined(paths, field, RULE)
    peak_bytes = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert len(result) == len(paths) > 1300
    assert peak_bytes < 8e6  # one number for each pair of ends would be 57 MB
