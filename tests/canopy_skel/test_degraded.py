import cv2
import numpy as np
import pytest
from scenes.wood import view_from

from canopy_skel.segmenters.degraded import DegradedSegmenter
from canopy_skel.segmenters.recorded import RecordedSegmenter

SIZE = (240, 320)
GREEN, GREY = (60, 140, 50), (150, 150, 150)


def orchard_view(index=0, **changes):
    """The sticks of wood, with edges of leaves, a wire across and far trunks in the picture."""
    picture = np.full((*SIZE, 3), 210, np.uint8)
    depth_m = np.full(SIZE, np.nan, np.float32)
    wood = view_from(index)
    for k in range(6):
        corner = (8 + 40 * (k % 3), 8 + 110 * (k // 3))
        far = (corner[0] + 34, corner[1] + 34)
        cv2.rectangle(picture, corner, far, GREEN, -1)
        depth_m[corner[1] : far[1], corner[0] : far[0]] = 0.9
    cv2.line(picture, (5, 222), (258, 226), (90, 90, 90), 2)
    for x in (265, 300):
        cv2.rectangle(picture, (x, 150), (x + 7, 230), GREY, -1)
        depth_m[150:230, x : x + 7] = 3.2
    picture[wood.instances > 0] = (90, 70, 50)
    depth_m = np.where(wood.instances > 0, wood.depth_m, depth_m)
    return view_from(index, color_rgb=picture, depth_m=depth_m, **changes)


def degraded(drop, false, seed=0):
    return DegradedSegmenter(
        inner=RecordedSegmenter(), drop_share=drop, false_share=false, seed=seed
    )


def same(a, b):
    return len(a) == len(b) and all(
        (x.instance, x.left_px, x.top_px, x.confidence)
        == (y.instance, y.left_px, y.top_px, y.confidence)
        and np.array_equal(x.mask, y.mask)
        for x, y in zip(a, b, strict=True)
    )


def test_nothing_dropped_and_nothing_added_is_what_was_recorded():
    view = orchard_view()
    assert same(degraded(0, 0).segment(view), RecordedSegmenter().segment(view))


@pytest.mark.parametrize(("drop", "left"), [(1 / 3, 2), (2 / 3, 1), (1.0, 0)])
def test_the_share_is_dropped_whole_instances_at_a_time(drop, left):
    view = orchard_view()
    recorded = RecordedSegmenter().segment(view)
    kept = degraded(drop, 0).segment(view)
    assert len(kept) == left
    numbers = [mask.instance for mask in kept]
    assert numbers == sorted(numbers)
    assert same(kept, [mask for mask in recorded if mask.instance in numbers])


def test_other_views_lose_others_and_the_same_seed_the_same():
    lost = set()
    for index in range(12):
        view = orchard_view(index)
        kept = degraded(1 / 3, 0).segment(view)
        assert same(kept, degraded(1 / 3, 0).segment(view))
        lost |= {1, 2, 3} - {mask.instance for mask in kept}
    assert lost == {1, 2, 3}


def test_false_branches_are_slender_and_not_where_branches_are():
    view = orchard_view()
    masks = degraded(0, 3).segment(view)
    false = masks[3:]
    assert len(false) == 9
    assert same(masks, degraded(0, 3).segment(view))
    assert not same(masks, degraded(0, 3, seed=1).segment(view))
    taken = np.zeros(SIZE, dtype=bool)
    for number, mask in enumerate(false, start=4):
        assert mask.instance == number
        assert 0 < mask.confidence < 1
        v, u = np.nonzero(mask.mask)
        v, u = v + mask.top_px, u + mask.left_px
        assert (view.instances[v, u] > 0).mean() < 0.1
        assert taken[v, u].mean() < 0.1
        taken[v, u] = True
        spread = np.linalg.svd(np.cov(np.stack([u, v])), compute_uv=False)
        assert np.sqrt(spread[1] / spread[0]) < 0.5


def test_leaves_wires_and_what_is_behind_are_mistaken_but_no_unmarked_wood():
    unmarked = orchard_view(instances=np.zeros(SIZE, np.uint16), scores=())
    recorded = orchard_view().instances > 0
    view = orchard_view()
    covered = np.zeros(SIZE, dtype=bool)
    for mask in degraded(0, 9).segment(view)[3:]:
        height, width = mask.mask.shape
        covered[mask.top_px : mask.top_px + height, mask.left_px : mask.left_px + width] |= (
            mask.mask
        )
    assert covered[:, 262:].any(), "background"
    assert covered[215:232, 20:250].any(), "wire"
    assert covered[8:42, :130].any(), "leaf"
    assert degraded(0, 9).segment(unmarked) == []
    assert (covered & recorded).sum() < 0.05 * recorded.sum()


def test_a_picture_without_edges_has_nothing_to_mistake():
    view = view_from(0, color_rgb=np.full((*SIZE, 3), 120, np.uint8))
    assert len(degraded(0, 3).segment(view)) == 3
