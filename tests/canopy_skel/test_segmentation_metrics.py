"""Figures of a segmenter: what is right counts, what is ignored does not, and nothing else."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from canopy_skel.metrics.lines import MiddleLine, overlap
from canopy_skel.metrics.segmentation import average_precision, judge, segmentation_scores
from canopy_skel.segment import BranchMask
from canopy_skel.segmenters.labels import labelled_image

SIZE = (120, 160)


def bar(start, end, width=7, size=SIZE):
    image = np.zeros(size, np.uint8)
    cv2.line(image, start, end, 1, width)
    return image.astype(bool)


def picture(*masks, ignore=None):
    empty = np.zeros(SIZE, bool)
    return labelled_image(
        np.zeros((*SIZE, 3), np.uint8), masks, empty if ignore is None else ignore
    )


def instance(mask, confidence=0.9, number=1):
    v, u = np.nonzero(mask)
    top, left = v.min(), u.min()
    part = mask[top : v.max() + 1, left : u.max() + 1]
    return BranchMask(
        instance=number, left_px=int(left), top_px=int(top), mask=part, confidence=confidence
    )


def scores(found, truth, threshold=0.5):
    return segmentation_scores([judge(found, truth, threshold=threshold)])


TRUNK = bar((20, 10), (30, 110), 15)
BRANCH = bar((50, 20), (140, 50), 5)
TWIG = bar((60, 110), (130, 90), 3)
TRUTH = picture(TRUNK, BRANCH, TWIG)
GOOD = [instance(mask, 1.0) for mask in (TRUNK, BRANCH, TWIG)]


def test_what_is_found_exactly_scores_one_everywhere():
    result = scores(GOOD, TRUTH).to_dict()
    assert result.pop("ece") == result.pop("brier") == 0
    assert result.pop("ece_wood") == result.pop("brier_wood") == 0
    assert (result.pop("pictures"), result.pop("threshold")) == (1, 0.5)
    assert (result.pop("instances_true"), result.pop("instances_found")) == (3, 3)
    assert result == pytest.approx(dict.fromkeys(result, 1.0), abs=0.02)
    assert result["line_ap"] == result["ap50"] == result["pixel_iou"] == 1.0


def test_nothing_found_is_no_precision_and_no_recall():
    result = scores([], TRUTH)
    assert (result.recall, result.line_ap, result.pixel_iou, result.cl_dice) == (0, 0, 0, 0)
    assert (result.precision, result.pixel_precision, result.ece) == (None, None, None)


def test_without_any_truth_nothing_can_be_recalled():
    result = scores(GOOD, picture())
    assert (result.precision, result.precision_wood, result.correctness) == (0, 0, 0)
    assert (result.recall, result.line_ap, result.completeness) == (None, None, None)
    assert result.ece == result.ece_wood == 1.0


def test_a_thin_branch_two_pixels_aside_is_the_same_line_but_not_the_same_mask():
    result = scores([instance(np.roll(TWIG, 2, axis=0))], picture(TWIG))
    assert (result.line_ap, result.completeness, result.correctness) == (1, 1, 1)
    assert result.ap50 == 0


@pytest.mark.parametrize(
    ("found", "like"),
    [
        (bar((50, 20), (140, 50), 3), True),
        (bar((50, 24), (140, 54), 5), True),
        (bar((50, 29), (140, 59), 5), False),
        (bar((60, 30), (130, 40), 5), False),
        (bar((50, 20), (92, 34), 5), False),
        (bar((50, 20), (100, 37), 5), True),
        (bar((102, 37), (140, 50), 5), False),
    ],
    ids=["thinner", "4 aside", "9 aside", "turned", "47 %", "55 %", "other 46 %"],
)
def test_lines_are_the_same_when_near_parallel_and_more_than_half_common(found, like):
    assert (scores([instance(found)], picture(BRANCH)).line_ap == 1.0) is like


def test_a_line_twice_as_long_is_another_branch():
    short = bar((50, 20), (90, 33), 5)
    assert scores([instance(BRANCH)], picture(short)).line_ap == 0


def test_a_branch_found_in_pieces_is_wood_but_counts_once():
    pieces = [bar((50, 20), (105, 38), 5), bar((106, 39), (140, 50), 5)]
    result = scores([instance(mask) for mask in pieces], picture(BRANCH))
    assert (result.precision, result.recall, result.precision_wood) == (0.5, 1.0, 1.0)
    assert result.pixel_iou > 0.95
    assert result.cl_dice > 0.95
    assert (result.ece, result.ece_wood) == (pytest.approx(0.4), pytest.approx(0.1))


def test_two_branches_in_a_row_taken_for_one_are_wood_but_neither_is_found():
    halves = [bar((50, 20), (90, 33), 5), bar((100, 37), (140, 50), 5)]
    result = scores([instance(BRANCH)], picture(*halves))
    assert (result.recall, result.precision, result.precision_wood) == (0, 0, 1.0)


def test_a_branch_found_twice_counts_once_by_the_surer_one():
    once = scores([instance(BRANCH, 0.9)], picture(BRANCH))
    twice = scores([instance(BRANCH, 0.7), instance(BRANCH, 0.9)], picture(BRANCH))
    assert (once.line_ap, twice.line_ap, twice.precision) == (1, 1, 0.5)


def test_a_stout_trunk_is_found_though_its_middle_is_off_by_more_than_a_twigs_width():
    trunk = bar((60, 0), (60, 119), 51)
    shifted = bar((68, 0), (68, 119), 51)
    result = scores([instance(shifted)], picture(trunk))
    assert (result.line_ap, result.correctness) == (1, 1)


def test_what_is_ignored_counts_neither_way():
    haze = bar((60, 70), (150, 75), 11)
    with_haze = scores([*GOOD, instance(bar((62, 70), (148, 75), 5), 0.95)], replace_ignore(haze))
    assert with_haze.to_dict() == pytest.approx(scores(GOOD, TRUTH).to_dict())
    blamed = scores([*GOOD, instance(bar((62, 70), (148, 75), 5), 0.95)], TRUTH)
    assert blamed.precision == 0.75
    assert blamed.pixel_precision < 1


def replace_ignore(ignore):
    return replace(TRUTH, ignore=ignore)


def test_the_threshold_is_for_precision_and_recall_but_ranks_are_for_the_average():
    false = instance(bar((10, 5), (150, 5), 3), 0.3)
    result = scores([*GOOD, false], TRUTH)
    assert (result.precision, result.instances_found, result.line_ap) == (1, 3, 1)
    lower = scores([*GOOD, false], TRUTH, threshold=0.2)
    assert (lower.precision, lower.instances_found, lower.line_ap) == (0.75, 4, 1)
    first = scores(
        [*GOOD[1:], replace(false, confidence=1.0), replace(GOOD[0], confidence=0.6)], TRUTH
    )
    assert first.line_ap == pytest.approx((2 / 3 + 2 / 3 + 3 / 4) / 3, abs=0.1)


def test_confidences_that_tell_the_truth_have_no_calibration_error():
    false = [instance(bar((10, 5), (14, 5), 3), 0.75)]
    right = [replace(mask, confidence=0.75) for mask in GOOD]
    assert scores([*right, *false], TRUTH).ece == pytest.approx(0)
    sure = [replace(mask, confidence=1.0) for mask in [*right, *false]]
    assert scores(sure, TRUTH).ece == pytest.approx(0.25)


def test_pictures_add_up_by_pixels_and_instances_not_by_averages():
    whole = segmentation_scores([judge(GOOD, TRUTH), judge([], picture(TWIG))])
    assert (whole.recall, whole.precision, whole.pictures) == (0.75, 1.0, 2)
    wood = (TRUTH.instances > 0).sum()
    assert whole.pixel_recall == pytest.approx(wood / (wood + TWIG.sum()))


def test_no_pictures_no_figures():
    result = segmentation_scores([])
    assert (result.pixel_iou, result.line_ap, result.ece, result.pictures) == (None, None, None, 0)


def test_an_instance_of_one_pixel_is_no_line_but_no_accident_either():
    dot = np.zeros(SIZE, bool)
    dot[5, 5] = True
    result = scores([instance(dot, 0.2), *GOOD], TRUTH)
    assert (result.line_ap, result.precision) == (1, 1)


POINTS = st.tuples(st.integers(5, 154), st.integers(5, 114))
BARS = st.lists(
    st.tuples(POINTS, POINTS, st.sampled_from([3, 5, 9, 15])).filter(
        lambda one: np.hypot(one[0][0] - one[1][0], one[0][1] - one[1][1]) > 25
    ),
    max_size=5,
)
SURE = st.floats(0.01, 1.0)


def drawn(bars):
    """Return the visible part of each bar as an exact, disjoint labelling shows it."""
    image = np.zeros(SIZE, int)
    for number, one in enumerate(bars, start=1):
        image[bar(*one)] = number
    masks = [image == number for number in range(1, len(bars) + 1)]
    return [mask for mask in masks if mask.sum() > 40]


@settings(max_examples=40, deadline=None)
@given(BARS, BARS, st.data())
def test_order_and_mirrors_change_nothing(true, found, data):
    true, found = drawn(true), drawn(found)
    sure = data.draw(st.lists(SURE, min_size=len(found), max_size=len(found), unique=True))
    instances = [instance(mask, c) for mask, c in zip(found, sure, strict=True)]
    expected = scores(instances, picture(*true))
    shuffled = data.draw(st.permutations(instances))
    assert scores(shuffled, picture(*true)).to_dict() == pytest.approx(expected.to_dict())
    for value in expected.to_dict().values():
        assert value is None or value >= 0
    turned = [instance(mask[::-1, ::-1], c) for mask, c in zip(found, sure, strict=True)]
    mirrored = scores(turned, picture(*[mask[::-1, ::-1] for mask in true]))
    for name in ("pixel_iou", "ap30", "ap50", "precision_wood", "ece_wood"):
        assert getattr(mirrored, name) == pytest.approx(getattr(expected, name)), name


@settings(max_examples=40, deadline=None)
@given(BARS, BARS)
def test_a_surely_false_instance_never_raises_a_figure_of_precision(true, found):
    corner = bar((0, 119), (30, 119), 1)
    true = [mask for mask in drawn(true) if not (mask & bar((0, 119), (45, 119), 31)).any()]
    instances = [instance(mask, 0.8) for mask in drawn(found)]
    before = scores(instances, picture(*true))
    after = scores([*instances, instance(corner, 0.9)], picture(*true))
    for name in ("precision", "precision_wood", "pixel_precision", "correctness", "pixel_iou"):
        old, new = getattr(before, name), getattr(after, name)
        assert new == 0 or old is None or new <= old + 1e-12, name
    for name in ("line_ap", "ap30", "ap50"):
        old, new = getattr(before, name), getattr(after, name)
        assert (old is None and new is None) or new <= old + 1e-12, name
    assert after.recall == before.recall


@settings(max_examples=40, deadline=None)
@given(BARS, st.data())
def test_losing_an_instance_never_raises_a_figure_of_recall(true, data):
    true = drawn(true)
    instances = [instance(mask, 0.8) for mask in true]
    kept = [one for one in instances if data.draw(st.booleans())]
    before, after = scores(instances, picture(*true)), scores(kept, picture(*true))
    for name in ("recall", "pixel_recall", "completeness", "line_ap", "ap50", "pixel_iou"):
        old, new = getattr(before, name), getattr(after, name)
        assert (old is None and new is None) or new <= old + 1e-12, name
    if true:
        assert before.ap50 == 1.0
        assert after.recall == pytest.approx(
            before.recall * len(kept) / len(instances), abs=0.5 if before.recall < 1 else 1e-9
        )


@settings(max_examples=200, deadline=None)
@given(
    st.lists(st.tuples(st.sampled_from([0.1, 0.4, 0.4, 0.7, 0.9]), st.booleans())),
    st.integers(0, 4),
)
def test_average_precision_equals_its_definition(pairs, missed):
    confidence = np.array([c for c, _ in pairs])
    right = np.array([r for _, r in pairs], dtype=bool)
    count = int(right.sum()) + missed
    expected = 0.0
    for step in range(1, count + 1):
        best = 0.0
        for level in set(confidence.tolist()):
            hits = int(right[confidence >= level].sum())
            if hits >= step:
                best = max(best, hits / int((confidence >= level).sum()))
        expected += best / count
    found = average_precision(confidence, right, count)
    assert found == (pytest.approx(expected) if count else None)


@given(
    st.floats(-40, 40),
    st.floats(0, np.pi),
    st.floats(20, 80),
    st.floats(1, 8),
)
def test_a_line_overlaps_itself_wholly_in_every_direction(shift, angle, length, radius):
    end = shift + length * np.array([np.cos(angle), np.sin(angle)])
    line = MiddleLine.of(np.array([[shift, shift, radius], [*end, radius]]))
    back = MiddleLine.of(np.array([[*end, radius], [shift, shift, radius]]))
    assert overlap(line, line) == pytest.approx(1.0)
    assert overlap(line, back) == pytest.approx(1.0)
    assert line.length_px == pytest.approx(length)
