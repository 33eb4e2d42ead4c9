import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scenes.drawn import drawn, polyline, straight
from scipy.ndimage import gaussian_filter
from scipy.ndimage import label as regions

from canopy_skel.kernels import strands
from canopy_skel.segmenters.labels import line_of_mask
from canopy_skel.segmenters.unet.features import FEATURES
from canopy_skel.segmenters.unet.grouping import Calibration, Grouping, grouped
from canopy_skel.segmenters.unet.targets import (
    ANGLE,
    ANGLE_STEPS,
    CENTRE,
    RADIUS,
    RADIUS_PX,
    STATE,
    Target,
    targets_of,
)


def perfect_maps(image):
    """What a network that knows the truth would say."""
    maps = targets_of(image).astype(np.float32)
    angle = maps[..., ANGLE] * (2 * np.pi / ANGLE_STEPS)
    low, high = np.log(RADIUS_PX)
    out = [
        np.where(maps[..., STATE] == Target.BRANCH, 4, -4),
        12 * gaussian_filter((maps[..., CENTRE] == 1).astype(float), 0.8) - 4,
        np.cos(angle),
        np.sin(angle),
        maps[..., RADIUS] / 255 * (high - low) + low,
    ]
    return np.stack(out).astype(np.float32)


def instances(lines, size=(240, 320)):
    """The masks found of perfect maps of these lines, at half size."""
    found = grouped(perfect_maps(drawn(lines, size)), Grouping())
    return [found.label == k for k in range(1, len(found.features) + 1)]


def covers(mask, truth):
    return (mask & truth).sum() / truth.sum(), (mask & truth).sum() / max(mask.sum(), 1)


@given(angle=st.floats(0, 180), radius=st.floats(3, 25), length=st.floats(100, 200))
def test_a_straight_branch_is_one_instance(angle, radius, length):
    line = straight((160, 120), angle, length, radius)
    (mask,) = instances([line])
    truth = targets_of(drawn([line]))[..., STATE] == Target.BRANCH
    share, pure = covers(mask, truth)
    assert share > 0.85
    assert pure == 1.0


@given(bend=st.floats(45, 90), turn=st.floats(0, 360), radius=st.floats(3, 8))
def test_a_bent_branch_is_cut_at_its_bend(bend, turn, radius):
    a, b = np.radians(turn), np.radians(turn + bend)
    corner = np.array([160.0, 120.0])
    start = corner - 80 * np.array([np.cos(a), np.sin(a)])
    end = corner + 80 * np.array([np.cos(b), np.sin(b)])
    masks = instances([polyline([start, corner, end], radius)])
    masks = sorted(masks, key=np.sum)[-2:]
    assert all(mask.sum() > 0.6 * 80 * 2 * radius / 4 for mask in masks)
    lines = [line_of_mask(mask) for mask in masks]
    steps = [line[-1, :2] - line[0, :2] for line in lines]
    angles = sorted(np.degrees(np.arctan2(s[1], s[0])) % 180 for s in steps)
    wanted = sorted([turn % 180, (turn + bend) % 180])
    apart = min(
        max(abs((x - y + 90) % 180 - 90) for x, y in zip(angles, order, strict=True))
        for order in (wanted, wanted[::-1])
    )
    assert apart < 10


def test_branches_that_touch_side_by_side_are_two():
    masks = instances([straight((160, 100), 0, 200, 8), straight((160, 116), 0, 200, 8)])
    assert len(masks) == 2
    assert [mask.sum() for mask in masks] == pytest.approx([1600 / 2] * 2, rel=0.15)


def test_a_crossing_keeps_the_branch_in_front_whole_and_parts_the_one_behind():
    masks = instances([straight((160, 120), 0, 240, 6), straight((160, 120), 75, 180, 6)])
    assert len(masks) == 3
    front = targets_of(drawn([straight((160, 120), 75, 180, 6)]))[..., STATE] == Target.BRANCH
    assert max(covers(mask, front)[0] for mask in masks) > 0.85


def test_instances_never_share_a_pixel_and_stay_on_the_branch_map():
    rng = np.random.default_rng(3)
    maps = rng.normal(0, 1, (5, 90, 120)).astype(np.float32)
    found = grouped(maps, Grouping(least_pixels=20, least_length_px=4))
    assert len(found.features) > 3
    assert found.label.max() == len(found.features)
    assert not (found.label[maps[0] <= -0.85] > 0).any()


def test_nothing_comes_of_nothing():
    for size in ((1, 1), (40, 60)):
        found = grouped(np.full((5, *size), -5, np.float32), Grouping())
        assert found.features.shape == (0, len(FEATURES))
        assert not found.label.any()


def test_features_measure_length_and_radius():
    found = grouped(perfect_maps(drawn([straight((160, 120), 30, 180, 7)])), Grouping())
    features = dict(zip(FEATURES, found.features[0], strict=True))
    assert np.exp(features["log_length"]) == pytest.approx(180, rel=0.1)
    assert np.exp(features["log_radius"]) == pytest.approx(7, rel=0.05)
    assert features["fill"] == pytest.approx(1, abs=0.12)
    assert features["stout"] == pytest.approx(14 / 180, rel=0.15)
    assert features["direction"] > 0.99
    assert features["axis"] > 0.99
    assert features["crook"] < 0.2
    assert features["sure"] > 0.9


def test_a_score_is_the_logistic_of_weighted_features():
    calibration = Calibration(weights=(2.0, -1.0), bias=0.5)
    scores = calibration.scores(np.array([[0.0, 0.0], [1.0, 0.5], [-3.0, 1.0]]))
    assert scores == pytest.approx(1 / (1 + np.exp([-0.5, -2.0, 6.5])))


def blobs(seed):
    """Random shapes, none at the rim."""
    rng = np.random.default_rng(seed)
    field = gaussian_filter(rng.normal(size=(40, 50)), rng.uniform(0.8, 3))
    core = field > rng.uniform(0.0, 0.5) * field.std()
    core[[0, -1]], core[:, [0, -1]] = False, False
    return core


@given(seed=st.integers(0, 10_000))
def test_thinning_keeps_what_hangs_together_and_leaves_lines(seed):
    before = blobs(seed)
    core = before.copy()
    cells = strands.thinned(core)
    line = np.zeros_like(core)
    line[cells[:, 0], cells[:, 1]] = True
    assert np.array_equal(line, core)
    assert not (line & ~before).any()
    eight = np.ones((3, 3))
    names, count = regions(before, eight)
    assert regions(line, eight)[1] == count
    assert set(names[line]) == set(range(1, count + 1))
    full = line[1:, 1:] & line[1:, :-1] & line[:-1, 1:] & line[:-1, :-1]
    assert full.mean() < 0.01


def fork(angle_deg):
    """Maps of a trunk that parts into a straight limb and one that leaves at an angle."""
    turn = np.radians(angle_deg)
    return [
        straight((130, 120), 0, 240, 7),
        polyline([(120, 120), (120 + 110 * np.cos(turn), 120 + 110 * np.sin(turn))], 5),
    ]


@pytest.mark.parametrize("angle", [40, 60, 90])
def test_at_a_fork_the_straightest_way_goes_on(angle):
    masks = instances(fork(angle))
    trunk = targets_of(drawn(fork(angle)[:1]))[..., STATE] == Target.BRANCH
    assert max(covers(mask, trunk)[0] for mask in masks) > 0.85
    assert len(masks) <= 3


@given(links=st.lists(st.booleans(), min_size=1, max_size=30))
def test_chains_are_the_paths_of_the_links(links):
    count = len(links) + 1
    link = np.full((count, 2), -1, np.int32)
    for k, joined in enumerate(links):
        if joined:
            link[k, 1], link[k + 1, 0] = k + 1, k
    order, starts = strands.chains(link)
    assert sorted(order) == list(range(count))
    found = {tuple(sorted(order[a:b])) for a, b in itertools.pairwise(starts)}
    wanted, run = set(), [0]
    for k, joined in enumerate(links, start=1):
        if not joined:
            wanted.add(tuple(run))
            run = []
        run.append(k)
    assert found == wanted | {tuple(run)}


def test_a_ring_is_one_chain():
    link = np.array([[2, 1], [0, 2], [1, 0]], np.int32)
    order, starts = strands.chains(link)
    assert starts.tolist() == [0, 3]
    assert sorted(order) == [0, 1, 2]
