"""What every Segmenter must do. Subclass it and give the fixtures.

`segmenter`: one to try. `view_with_branches`: a view in which it finds at least two branches.
`empty_view`: one in which there is nothing to find.
"""

import numpy as np


class SegmenterContract:
    def test_masks_lie_in_the_picture_and_have_pixels(self, segmenter, view_with_branches):
        height, width = view_with_branches.color_rgb.shape[:2]
        masks = segmenter.segment(view_with_branches)
        assert len(masks) >= 2
        for mask in masks:
            assert mask.mask.dtype == bool
            assert mask.mask.any()
            assert 0 <= mask.left_px <= width - mask.mask.shape[1]
            assert 0 <= mask.top_px <= height - mask.mask.shape[0]

    def test_instances_have_numbers_of_their_own_and_scores(self, segmenter, view_with_branches):
        masks = segmenter.segment(view_with_branches)
        assert len({mask.instance for mask in masks}) == len(masks)
        assert all(mask.instance >= 1 for mask in masks)
        assert all(0 < mask.confidence <= 1 for mask in masks)

    def test_instances_do_not_overlap(self, segmenter, view_with_branches):
        count = np.zeros(view_with_branches.color_rgb.shape[:2], int)
        for mask in segmenter.segment(view_with_branches):
            height, width = mask.mask.shape
            rows = slice(mask.top_px, mask.top_px + height)
            count[rows, mask.left_px : mask.left_px + width] += mask.mask
        assert count.max() == 1

    def test_the_same_view_gives_the_same_instances(self, segmenter, view_with_branches):
        first, second = (segmenter.segment(view_with_branches) for _ in range(2))
        assert len(first) == len(second)
        for a, b in zip(first, second, strict=True):
            assert (a.instance, a.left_px, a.top_px) == (b.instance, b.left_px, b.top_px)
            assert a.confidence == b.confidence
            assert np.array_equal(a.mask, b.mask)

    def test_nothing_is_found_where_nothing_is(self, segmenter, empty_view):
        assert len(segmenter.segment(empty_view)) == 0
