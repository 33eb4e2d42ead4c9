import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from pycocotools import mask as coco_mask

from mock_hw.orchard.outlines import box, polygons, run_lengths

# pycocotools 2.0 is older than numpy 2.
pytestmark = pytest.mark.filterwarnings("ignore:__array__ implementation:DeprecationWarning")
MASKS = arrays(bool, st.tuples(st.integers(1, 14), st.integers(1, 14))).filter(np.any)


def read_as_coco(segmentation, shape):
    height, width = shape
    encoded = coco_mask.frPyObjects(segmentation, height, width)
    return coco_mask.decode(
        encoded if isinstance(encoded, dict) else coco_mask.merge(encoded)
    ).astype(bool)


@given(MASKS)
def test_a_coco_reader_gets_the_mask_back_to_the_pixel(mask):
    # Parts that touch at a corner are one part; readers unite polygons, so all come back.
    assert np.array_equal(read_as_coco(polygons(mask), mask.shape), mask)


@given(MASKS)
def test_outlines_have_corners_only_and_lie_in_the_box(mask):
    left, top, width, height = box(mask)
    points = np.concatenate([np.reshape(one, (-1, 2)) for one in polygons(mask)])
    assert points.min(axis=0).tolist() == [left, top]
    assert points.max(axis=0).tolist() == [left + width, top + height]


def test_a_straight_branch_keeps_its_width():
    mask = np.zeros((20, 30), dtype=bool)
    mask[8:11, 4:26] = True
    (outline,) = polygons(mask)
    assert sorted(zip(outline[::2], outline[1::2], strict=True)) == [
        (4, 8),
        (4, 11),
        (26, 8),
        (26, 11),
    ]
    assert box(mask) == [4, 8, 22, 3]


def test_a_leaf_in_the_middle_of_a_branch_is_no_branch():
    mask = np.ones((9, 9), dtype=bool)
    mask[2:4, 3:5] = mask[6, 6:8] = False
    (outline,) = polygons(mask)
    assert np.array_equal(read_as_coco([outline], mask.shape), mask)


@given(MASKS)
def test_run_lengths_are_read_back_as_the_mask(mask):
    encoded = {"size": list(mask.shape), "counts": run_lengths(mask)}
    assert np.array_equal(read_as_coco(encoded, mask.shape), mask)


@pytest.mark.parametrize("value", [0, 1])
def test_run_lengths_start_with_zeros(value):
    mask = np.array([[value, 1]], dtype=bool)
    assert run_lengths(mask) == ([0, 2] if value else [1, 1])
