"""Mask R-CNN behind the contract of all segmenters; the network itself where torchvision is."""

from dataclasses import replace
from importlib.util import find_spec

import cv2
import numpy as np
import pytest
import torch
from contracts.segmenter import SegmenterContract
from hypothesis import given
from hypothesis import strategies as st
from scenes.drawn import BARK, drawn, straight
from scenes.views import view_of

from canopy_skel.errors import UsageError, ViewError
from canopy_skel.segment import BranchMask
from canopy_skel.segmenters.maskrcnn.merging import disjoint, merged
from canopy_skel.segmenters.maskrcnn.segmenter import MaskRcnnSegmenter
from canopy_skel.segmenters.maskrcnn.weights import Detector

needs_torchvision = pytest.mark.skipif(
    find_spec("torchvision") is None,
    reason="needs torchvision, which is 5 GB with its torch: `make maskrcnn` runs it",
)
BARS = [straight((50, 60), 80, 90, 8), straight((115, 60), 15, 70, 7)]
SIZE = (120, 160)


class SeesBark(torch.nn.Module):
    """Stands in for the network: every patch of bark twice over, with a score by its size."""

    def forward(self, pictures):
        return [self.found(picture) for picture in pictures]

    def found(self, picture):
        apart = (picture * 255).permute(1, 2, 0).cpu().numpy() - np.array(BARK)
        count, label = cv2.connectedComponents((np.abs(apart).max(axis=2) < 30).astype(np.uint8))
        masks = [label == k for k in range(1, count) if (label == k).sum() > 60]
        double = [mask for mask in masks for _ in range(2)]
        scores = [0.99 - 0.02 * k for k in range(len(double))]
        return {
            "scores": torch.tensor(scores),
            "masks": torch.tensor(np.array(double, np.float32).reshape(-1, 1, *label.shape)),
        }


def segmenter_of(network, **changes):
    fields = {"network": network, "norm": "group", "size_px": (160, 120), "least_score": 0.5}
    return MaskRcnnSegmenter(Detector(**(fields | changes)))


class TestContract(SegmenterContract):
    @pytest.fixture
    def segmenter(self):
        return segmenter_of(SeesBark())

    @pytest.fixture
    def view_with_branches(self):
        return view_of(drawn(BARS, SIZE).color_rgb)

    @pytest.fixture
    def empty_view(self):
        return view_of(drawn([], SIZE).color_rgb)


def test_a_larger_picture_is_scaled_and_its_masks_come_back_to_its_size():
    image = drawn([4 * bar for bar in BARS], (480, 640))
    masks = segmenter_of(SeesBark()).segment(view_of(image.color_rgb))
    assert len(masks) == 2
    found = np.zeros((480, 640), bool)
    for mask in masks:
        height, width = mask.mask.shape
        found[mask.top_px : mask.top_px + height, mask.left_px : mask.left_px + width] |= mask.mask
    wood = image.instances > 0
    assert (found & wood).sum() > 0.85 * (found | wood).sum()


def test_only_what_is_sure_enough_is_reported():
    view = view_of(drawn(BARS, SIZE).color_rgb)
    assert len(segmenter_of(SeesBark(), least_score=0.94).segment(view)) == 2
    assert len(segmenter_of(SeesBark(), least_score=0.96).segment(view)) == 1
    assert len(segmenter_of(SeesBark(), least_score=0.98).segment(view)) == 1
    assert segmenter_of(SeesBark(), least_score=1.0).segment(view) == []


def test_a_single_pixel_is_a_picture_and_a_grey_one_is_refused():
    assert segmenter_of(SeesBark()).segment(view_of(np.zeros((1, 1, 3), np.uint8))) == []
    with pytest.raises(ViewError, match=r"needs .H, W, 3. uint8"):
        segmenter_of(SeesBark()).segment(view_of(np.zeros((4, 5), np.uint8)))


def box(left, top, width, height, confidence=0.9):
    mask = np.ones((height, width), bool)
    return BranchMask(instance=1, left_px=left, top_px=top, mask=mask, confidence=confidence)


def test_masks_are_joined_as_the_authors_join_them():
    (one,) = merged([box(0, 0, 10, 4, 0.9), box(4, 0, 10, 4, 0.5)])
    assert (one.left_px, one.mask.shape, one.mask.all()) == (0, (4, 14), True)
    assert one.confidence == pytest.approx(0.7)
    assert len(merged([box(0, 0, 10, 4), box(6, 0, 10, 4)])) == 2
    assert len(merged([box(0, 0, 40, 4), box(35, 0, 8, 4)])) == 1
    # Halves of a branch are joined over the piece that overlaps both.
    assert len(merged([box(0, 0, 20, 4), box(16, 0, 20, 4), box(8, 0, 20, 4)])) == 1
    assert merged([]) == []


def test_a_mask_within_the_box_of_another_is_another_branch():
    diagonal = replace(box(0, 0, 40, 40), mask=np.eye(40, dtype=bool))
    other = replace(box(0, 0, 40, 40), mask=np.eye(40, dtype=bool)[::-1])
    assert len(merged([diagonal, other])) == 2


@given(
    st.lists(
        st.builds(
            box,
            st.integers(0, 20),
            st.integers(0, 20),
            st.integers(1, 20),
            st.integers(1, 20),
            st.floats(0.1, 1.0),
        ),
        max_size=6,
    )
)
def test_joining_keeps_the_pixels_and_dividing_gives_each_to_one(masks):
    def pixels(some):
        count = np.zeros((40, 40), int)
        for mask in some:
            height, width = mask.mask.shape
            part = count[mask.top_px : mask.top_px + height, mask.left_px : mask.left_px + width]
            part += mask.mask
        return count

    joined = merged(masks)
    assert np.array_equal(pixels(joined) > 0, pixels(masks) > 0)
    apart = disjoint(joined, (40, 40))
    assert np.array_equal(pixels(apart), pixels(masks) > 0)
    assert [mask.instance for mask in apart] == list(range(1, len(apart) + 1))
    assert len(merged(joined)) <= len(joined)


@pytest.mark.skipif(find_spec("torchvision") is not None, reason="torchvision is here")
def test_without_torchvision_one_line_says_what_to_do():
    from canopy_skel.segmenters.maskrcnn.network import build

    with pytest.raises(UsageError, match=r"needs torchvision: install the extra .*make maskrcnn"):
        build()


@pytest.fixture(scope="module")
def trained():
    from canopy_skel.segmenters.maskrcnn.network import build
    from service.training.maskrcnn import MaskRcnnPlan, train_maskrcnn

    torch.manual_seed(1)
    network = build("group", (96, 64))
    before = {name: value.clone() for name, value in network.state_dict().items()}
    losses = []
    images = [drawn([bar * [0.5, 0.5, 0.5] for bar in BARS], (64, 96), seed=s) for s in (1, 2)]
    plan = MaskRcnnPlan(steps=4, batch=1, warm_up=1, rate=0.002)
    steps = train_maskrcnn(
        network, images, plan, (96, 64), lambda step, loss: losses.append((step, loss))
    )
    assert steps == 4
    assert [step for step, _ in losses] == [1, 2, 3, 4]
    return network, before, [loss for _, loss in losses]


@needs_torchvision
class TestNetwork:
    def test_a_few_steps_change_all_of_it_and_bring_the_loss_down(self, trained):
        network, before, losses = trained
        after = network.state_dict()
        changed = [name for name in before if not torch.equal(before[name], after[name])]
        assert {name.split(".")[0] for name in changed} == {"backbone", "rpn", "roi_heads"}
        assert any("body.conv1" in name for name in changed)
        assert np.isfinite(losses).all()
        assert min(losses[2:]) < losses[0]

    def test_what_is_saved_comes_back_and_segments_alike(self, trained, tmp_path):
        from canopy_skel.segmenters.maskrcnn.weights import load, save

        detector = Detector(network=trained[0], norm="group", size_px=(96, 64), least_score=0.0)
        save(tmp_path / "m.pt", detector, {"training": {"steps": 4}})
        again = load(tmp_path / "m.pt")
        assert (again.norm, again.size_px, again.least_score) == ("group", (96, 64), 0.0)
        assert (tmp_path / "m.pt").stat().st_size < 95e6
        for name, value in detector.network.state_dict().items():
            assert torch.allclose(value, again.network.state_dict()[name], rtol=2e-3, atol=1e-4)
        view = view_of(drawn(BARS, (64, 96)).color_rgb)
        masks = [MaskRcnnSegmenter(one).segment(view) for one in (again, load(tmp_path / "m.pt"))]
        assert [m.confidence for m in masks[0]] == [m.confidence for m in masks[1]]
        data = (tmp_path / "m.pt").read_bytes()
        (tmp_path / "m.pt").write_bytes(data[:-7])
        with pytest.raises(UsageError, match="truncated or changed"):
            load(tmp_path / "m.pt")

    def test_a_checkpoint_of_torchvision_is_gone_on_from(self, tmp_path):
        from torchvision.models.detection import maskrcnn_resnet50_fpn

        from canopy_skel.segmenters.maskrcnn.network import pretrained

        other = maskrcnn_resnet50_fpn(weights=None, weights_backbone=None)
        path = tmp_path / "maskrcnn_resnet50_fpn_coco.pth"
        torch.save(other.state_dict(), path)
        network = pretrained(path, (96, 64))
        own, given_state = network.state_dict(), other.state_dict()
        for name in ("backbone.body.layer3.0.conv2.weight", "rpn.head.cls_logits.weight"):
            assert torch.equal(own[name], given_state[name])
        assert own["roi_heads.box_predictor.cls_score.weight"].shape[0] == 2
        torch.save({"backbone.body.conv1.weight": torch.zeros(3)}, path)
        with pytest.raises(UsageError, match="of another architecture: backbone"):
            pretrained(path, (96, 64))
        named = tmp_path / "maskrcnn_resnet50_fpn_coco-0123abcd.pth"
        path.rename(named)
        with pytest.raises(UsageError, match="truncated or changed"):
            pretrained(named, (96, 64))
