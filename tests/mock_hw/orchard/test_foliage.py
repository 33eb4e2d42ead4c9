import itertools

import numpy as np
import pytest

from canopy_skel.errors import UsageError
from mock_hw.orchard import renderer
from mock_hw.orchard.foliage import canopy_of, fit_canopy, fit_foliage, framed
from mock_hw.orchard.instances import fragments_of
from mock_hw.orchard.light import fair_weather
from mock_hw.orchard.path import OAK_D, camera_path
from mock_hw.orchard.scene import build_scene

POSES = camera_path(10)[1:9:3]
MOST = 3000


@pytest.fixture(scope="module")
def canopy(apple):
    return canopy_of(apple, seed=0, trellis=True, most_leaves=MOST, poses=POSES)


@pytest.mark.parametrize("more", [0, 1])
def test_one_pass_over_the_leaves_sees_what_a_rendering_of_any_canopy_sees(canopy, apple, more):
    hiding = canopy.cover[0][(canopy.cover[0] >= 0) & (canopy.cover[0] < 600)]
    count = int(hiding.max()) + more
    scene = build_scene(apple, count, fair_weather(), seed=0, rows=False, trellis=True)
    found = np.zeros(len(apple.position), dtype=bool)
    for pose, vertex, cover in zip(POSES, canopy.vertex, canopy.cover, strict=True):
        picture = renderer.draw(scene.mesh, pose, OAK_D)
        assert np.array_equal(np.where(cover >= count, vertex, -1), picture.vertex)
        fragments = fragments_of(picture.vertex, apple, scene.piece, pose, OAK_D)
        found[fragments.vertex[fragments.detectable[fragments.fragment]]] = True
    assert np.array_equal(canopy.detected(count), found)


def test_more_leaves_leave_less_to_detect(canopy):
    v_det = [canopy.v_det(count) for count in (0, 200, 600, 1500, 3000)]
    assert all(b <= a + 0.01 for a, b in itertools.pairwise(v_det))
    assert v_det[0] > 0.7
    assert v_det[-1] < v_det[0] - 0.2


def test_bisection_meets_the_target(canopy):
    fit = fit_canopy(canopy, 3, MOST)
    assert fit.target == 0.50
    assert fit.v_det == pytest.approx(fit.target, abs=0.03)
    assert canopy.v_det(fit.leaf_count) == fit.v_det


def test_densities_are_ordered(canopy):
    counts = [fit_canopy(canopy, density, MOST).leaf_count for density in (2, 3, 4)]
    assert counts[0] < counts[1] < counts[2]


def test_the_foot_of_the_trunk_is_in_no_frame(apple):
    inside = framed(apple, camera_path(10), OAK_D)
    assert not inside[0]
    assert inside.mean() > 0.95


def test_an_unknown_density_is_refused(apple):
    with pytest.raises(UsageError, match="no foliage density 5; choose 1, 2, 3 or 4"):
        fit_foliage(apple, (5,), seed=0, trellis=False)
