from dataclasses import replace

import numpy as np
import pytest
import torch
from scenes.drawn import drawn, straight
from scenes.scorers import constant_scorer

from canopy_skel.segmenters.unet.grouping import Grouping
from canopy_skel.segmenters.unet.network import Known, Maps, UNet
from canopy_skel.segmenters.unet.scorer import ACROSS, ALONG, BESIDE
from canopy_skel.segmenters.unet.segmenter import UNetSegmenter
from canopy_skel.segmenters.unet.targets import places_of, targets_of
from canopy_skel.segmenters.unet.weights import Model
from service.training.scoring import Examples, examples_of, taught

CHANNELS = (4, 6, 8)
KNOWN = len(Maps._fields) + CHANNELS[0]


def examples(count=600, seed=0):
    """Strips that tell right from wrong by one channel beyond the end of the strand."""
    rng = np.random.default_rng(seed)
    strips = rng.normal(size=(count, KNOWN + BESIDE, ALONG, ACROSS)).astype(np.float16)
    right = rng.random(count) < 0.5
    strips[:, 0, -6:] += np.where(right, 0, 3).astype(np.float16)[:, None, None]
    strips[:, 0, :6] += np.where(right, 0, 3).astype(np.float16)[:, None, None]
    return Examples(strips=strips, overlap=np.where(right, 0.9, 0.1))


def logits(scorer, strips):
    with torch.inference_mode():
        return scorer(torch.from_numpy(strips.astype(np.float32))).numpy()


def test_a_scorer_learns_what_tells_right_from_wrong():
    scorer = taught(examples(), 30)
    others = examples(seed=1)
    right = others.overlap > 0.5
    assert ((logits(scorer, others.strips) > 0) == right).mean() > 0.95
    again = taught(examples(), 30)
    assert np.array_equal(logits(again, others.strips), logits(scorer, others.strips))


def test_one_that_knows_already_is_gone_on_with_and_stays_as_it_was():
    scorer = taught(examples(), 30)
    before = {name: value.clone() for name, value in scorer.state_dict().items()}
    further = taught(examples(seed=2), 5, scorer)
    others = examples(seed=1)
    assert ((logits(further, others.strips) > 0) == (others.overlap > 0.5)).mean() > 0.95
    assert all(torch.equal(before[name], value) for name, value in scorer.state_dict().items())
    assert not torch.equal(further.judges[0].decide[-1].weight, scorer.judges[0].decide[-1].weight)
    assert torch.equal(further.middle, scorer.middle)


def test_without_examples_a_scorer_stays_or_says_one_half():
    none = Examples(strips=examples(4).strips[:0], overlap=np.zeros(0))
    strips = examples(5).strips
    assert (logits(taught(none, 10), strips) == 0).all()
    known = taught(examples(), 5)
    assert np.array_equal(logits(taught(none, 10, known), strips), logits(known, strips))


def test_one_that_never_saw_an_example_learns_as_a_new_one():
    none = Examples(strips=examples(4).strips[:0], overlap=np.zeros(0))
    scorer = taught(examples(), 30, taught(none, 10))
    others = examples(seed=1)
    assert ((logits(scorer, others.strips) > 0) == (others.overlap > 0.5)).mean() > 0.95


def test_no_pictures_are_no_examples(model):
    assert len(examples_of(model, []).overlap) == 0


@pytest.fixture
def model():
    return Model(
        network=UNet(CHANNELS).eval(),
        channels=CHANNELS,
        zoom=1.0,
        grouping=Grouping(centres=(0.15,)),
        scorer=constant_scorer(CHANNELS, 0.0),
        least_score=0.0,
    )


def test_examples_are_strands_with_what_they_share_with_the_labels(model, monkeypatch):
    image = drawn([straight((80, 60), 20, 110, 8), straight((230, 150), 70, 120, 6)], (240, 320))
    targets = targets_of(image)
    known = np.zeros((KNOWN, 120, 160), np.float32)
    wood = targets[..., 0] == 1
    angle = targets[..., 2] * (2 * np.pi / 255)
    known[0], known[1] = np.where(wood, 4, -4), np.where(targets[..., 1] == 1, 4, -4)
    known[2], known[3] = np.cos(angle), np.sin(angle)
    known[4] = np.log(7)
    known[5:8] = places_of(targets).transpose(2, 0, 1)
    monkeypatch.setattr(UNetSegmenter, "known", lambda self, color: Known(known[:8], known[8:]))
    both = examples_of(model, [image])
    assert both.strips.shape == (2, KNOWN + BESIDE, ALONG, ACROSS)
    assert (both.overlap > 0.8).all()
    one = replace(image, instances=np.where(image.instances == 2, 0, image.instances))
    assert sorted(examples_of(model, [one]).overlap > 0.5) == [False, True]
    ignored = replace(one, ignore=image.instances == 2)
    assert (examples_of(model, [ignored]).overlap > 0.8).tolist() == [True]
    assert len(examples_of(model, [image, image]).overlap) == 4
