import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scenes.drawn import straight

from canopy_skel.metrics.instances import (
    Judged,
    average_precision,
    calibration_error,
    judge,
    on_line,
    precision_and_recall,
)

TRUTH = straight((200, 150), 20, 100, 4)


def moved(line, along=0.0, across=0.0, turn_deg=0.0, scale=1.0):
    middle = line[:, :2].mean(axis=0)
    axis = line[-1, :2] - line[0, :2]
    axis /= np.linalg.norm(axis)
    c, s = np.cos(np.radians(turn_deg)), np.sin(np.radians(turn_deg))
    points = (line[:, :2] - middle) * scale @ np.array([[c, s], [-s, c]]) + middle
    points = points + along * axis + across * np.array([-axis[1], axis[0]])
    return np.column_stack([points, line[:, 2]])


def none(count):
    return np.zeros(count, dtype=bool)


@given(
    along=st.floats(-40, 40),
    across=st.floats(-6, 6),
    turn=st.floats(0, 180),
    radius=st.floats(2, 9),
)
def test_a_line_shifted_less_than_half_its_length_is_found(along, across, turn, radius):
    truth = straight((200, 150), turn, 100, radius)
    shifted = moved(truth, along=along, across=0.9 * across / 6 * (radius + 2.5))
    assert on_line(shifted, truth) > 0.5


@pytest.mark.parametrize(
    "change",
    [
        {"along": 61},
        {"across": 7.5},
        {"turn_deg": 11},
        {"scale": 0.3},
        {"scale": 2.5},
    ],
)
def test_a_line_too_far_off_is_not(change):
    assert on_line(TRUTH, TRUTH) == 1.0
    assert on_line(moved(TRUTH, **change), TRUTH) == 0.0


def test_each_truth_is_found_once_by_the_best_score():
    lines = [moved(TRUTH, along=5), TRUTH, moved(TRUTH, across=40)]
    judged = judge(lines, np.array([0.7, 0.9, 0.8]), none(3), [TRUTH])
    assert judged.found.tolist() == [False, True, False]
    assert judged.real.tolist() == [True, True, False]
    assert judged.matched.tolist() == [True]


def test_part_of_a_branch_is_real_but_not_found():
    judged = judge([moved(TRUTH, scale=0.3)], np.array([0.9]), none(1), [TRUTH])
    assert (judged.found.any(), judged.real.all(), judged.matched.any()) == (False, True, False)


def test_two_in_a_row_taken_for_one_are_real():
    first, second = (moved(TRUTH, along=shift) for shift in (-60, 60))
    judged = judge([moved(TRUTH, scale=2.2)], np.array([0.9]), none(1), [first, second])
    assert judged.real.all()
    assert not judged.found.any()


def test_what_lies_on_the_ignored_does_not_count_unless_it_is_right():
    lines = [moved(TRUTH, across=50), TRUTH]
    ignored = np.array([True, True])
    judged = judge(lines, np.array([0.9, 0.8]), ignored, [TRUTH])
    assert judged.number.tolist() == [1]
    assert judged.found.tolist() == [True]


def verdicts(scores, found, truths):
    found = np.array(found, dtype=bool)
    return Judged(
        scores=np.array(scores),
        found=found,
        real=found,
        number=np.arange(len(found)),
        matched=np.arange(truths) < found.sum(),
    )


def test_average_precision_is_the_area_under_precision_over_recall():
    one = verdicts([0.9, 0.5], [True, False], 2)
    other = verdicts([0.7, 0.6], [False, True], 2)
    # Ranked: hit, miss, hit, miss; recall 1/4 at precision 1, 1/2 at 2/3.
    assert average_precision([one, other]) == pytest.approx(0.25 * 1 + 0.25 * 2 / 3)
    assert average_precision([verdicts([], [], 3)]) == 0.0
    assert average_precision([verdicts([0.5], [False], 0)]) == 0.0


def test_precision_and_recall_count_from_a_score_on():
    picture = verdicts([0.9, 0.8, 0.3], [True, False, True], 4)
    assert precision_and_recall([picture], 0.5) == (0.5, 0.25)
    assert precision_and_recall([picture], 0.95) == (1.0, 0.0)


@given(seed=st.integers(0, 100))
def test_honest_scores_have_little_calibration_error(seed):
    rng = np.random.default_rng(seed)
    scores = rng.random(4000)
    assert calibration_error(scores, rng.random(4000) < scores) < 0.05
    assert calibration_error(scores, rng.random(4000) < scores**4) > 0.15
    assert calibration_error(np.zeros(0), none(0)) == 0.0
