"""How far a view that agrees with no other may be taken, and by how little wood."""

import numpy as np
import pytest

from canopy_skel.fusion import Observed
from canopy_skel.poses import PoseConfig, found_again

EVERY_M = 0.005


@pytest.fixture(scope="module")
def wood():
    """Points and directions (600, 3) along twelve sticks that lie all ways."""
    random = np.random.default_rng(1)
    ways = random.normal(size=(12, 3))
    ways /= np.linalg.norm(ways, axis=1, keepdims=True)
    along = EVERY_M * np.arange(50)[:, None]
    sticks = [
        start + along * way
        for start, way in zip(random.uniform(-0.5, 0.5, (12, 3)), ways, strict=True)
    ]
    return np.vstack(sticks), np.repeat(ways, 50, axis=0)


def found(wood, by_m, points=600):
    places, ways = wood
    others = Observed(
        vertices_in_base=places,
        directions=ways,
        support=np.ones((len(places), 7)),
        edges=np.zeros((0, 2), np.int64),
    )
    return found_again(0, places[:points] + by_m, ways[:points], others, PoseConfig())


@pytest.mark.parametrize("by_m", [[0.05, 0.05, 0.05], [-0.08, 0, 0.03]])
def test_a_view_is_taken_back_by_what_it_is_off(wood, by_m):
    back = found(wood, by_m)
    assert back.brought_back
    assert back.moved == pytest.approx(
        np.block([[np.eye(3), -np.c_[by_m]], [0, 0, 0, 1]]), abs=1e-3
    )
    assert back.before_m == pytest.approx(np.linalg.norm(by_m), abs=1e-3)


def test_no_farther_than_15_cm_although_it_would_fit(wood):
    assert found(wood, [0.09, 0.09, 0.09]) is None


def test_not_by_a_metre_of_wood(wood):
    assert found(wood, [0.05, 0, 0], points=250) is not None
    assert found(wood, [0.05, 0, 0], points=249) is None


def test_not_where_no_alignment_succeeds(wood):
    assert found(wood, [1.0, 0, 0]) is None
