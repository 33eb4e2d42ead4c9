import numpy as np
import pytest
import torch
from scenes.drawn import drawn, straight

from canopy_skel.segmenters.unet.loss import loss_of
from canopy_skel.segmenters.unet.network import Maps
from canopy_skel.segmenters.unet.targets import (
    ANGLE,
    ANGLE_STEPS,
    CENTRE,
    RADIUS,
    RADIUS_PX,
    STATE,
    Target,
    places_of,
    targets_of,
)

PARTS = ("branch", "centre", "direction", "radius", "middle", "length")


@pytest.fixture
def asked():
    """Targets and places of a batch of one, part of it to be ignored."""
    image = drawn([straight((80, 60), 20, 90, 4), straight((200, 160), 110, 120, 7)])
    image.ignore[200:, :100] = True
    targets = targets_of(image)
    return torch.from_numpy(targets[None]), torch.from_numpy(places_of(targets)[None])


def perfect(targets, places):
    """What a network that knows the truth would say."""
    angle = targets[..., ANGLE] * (2 * np.pi / ANGLE_STEPS)
    low, high = np.log(RADIUS_PX)
    return Maps(
        branch=torch.where(targets[..., STATE] == Target.BRANCH, 20.0, -20.0),
        centre=torch.where(targets[..., CENTRE] == 1, 20.0, -20.0),
        cosine=torch.cos(angle),
        sine=torch.sin(angle),
        log_radius=targets[..., RADIUS] / 255 * (high - low) + low,
        middle_u=places[..., 0],
        middle_v=places[..., 1],
        log_length=places[..., 2],
    )


def parts(loss):
    return [float(getattr(loss, name)) for name in PARTS]


def test_nothing_is_wrong_with_perfect_maps(asked):
    assert parts(loss_of(perfect(*asked), *asked)) == pytest.approx([0] * 6, abs=0.011)


def test_places_are_wrong_by_half_lengths_and_lengths_by_their_logarithm(asked):
    maps = perfect(*asked)
    maps = maps._replace(
        middle_u=maps.middle_u + 0.3,
        middle_v=maps.middle_v - 0.4,
        log_length=maps.log_length - np.log(2),
    )
    loss = loss_of(maps, *asked)
    assert float(loss.middle) == pytest.approx(0.5, rel=0.01)
    assert float(loss.length) == pytest.approx(np.log(2), rel=0.01)
    assert parts(loss)[:4] == pytest.approx([0] * 4, abs=1e-3)


def test_ignored_cells_count_nowhere_and_background_has_no_place(asked):
    state = asked[0][..., STATE]
    maps = perfect(*asked)
    right = parts(loss_of(maps, *asked))
    ignored = state == Target.IGNORE
    assert ignored.any()
    wild = Maps(*(torch.where(ignored, 7.0, one) for one in maps))
    assert parts(loss_of(wild, *asked)) == right
    nowhere = state != Target.BRANCH
    astray = {name: torch.where(nowhere, 7.0, getattr(maps, name)) for name in Maps._fields[2:]}
    assert parts(loss_of(maps._replace(**astray), *asked)) == right


@pytest.mark.parametrize(("weight", "learned"), [(0.0, 5), (1.0, 8)])
def test_without_weight_places_are_not_learned(asked, weight, learned):
    maps = Maps(*(one.clone().add(0.1).requires_grad_() for one in perfect(*asked)))
    loss_of(maps, *asked).total(1.0, weight).backward()
    assert [bool(one.grad.any()) for one in maps] == [k < learned for k in range(len(maps))]
