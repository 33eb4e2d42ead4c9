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
from canopy_skel.segmenters.unet.grouping import Candidates, Grouping, candidates_of, chosen
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

ONE_WAY = Grouping(centres=(0.15,))


def perfect_maps(image):
    """What a network that knows the truth would say."""
    targets = targets_of(image)
    maps = targets.astype(np.float32)
    angle = maps[..., ANGLE] * (2 * np.pi / ANGLE_STEPS)
    low, high = np.log(RADIUS_PX)
    out = [
        np.where(maps[..., STATE] == Target.BRANCH, 4, -4),
        12 * gaussian_filter((maps[..., CENTRE] == 1).astype(float), 0.8) - 4,
        np.cos(angle),
        np.sin(angle),
        maps[..., RADIUS] / 255 * (high - low) + low,
        *places_of(targets).transpose(2, 0, 1),
    ]
    return np.stack(out).astype(np.float32)


def found(maps, grouping=ONE_WAY):
    """What comes of maps if every strand is as likely as its number of cells says."""
    candidates = candidates_of(maps, grouping)
    sizes = np.array([len(cells) for cells in candidates.cells], dtype=float)
    return chosen(maps, candidates, sizes / (1 + sizes), grouping)


def instances(lines, size=(240, 320)):
    """The masks found of perfect maps of these lines, at half size."""
    strands_found, scores = found(perfect_maps(drawn(lines, size)))
    return [strands_found.label == k for k in range(1, len(scores) + 1)]


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


def noisy_maps():
    maps = np.random.default_rng(3).normal(0, 1, (8, 90, 120)).astype(np.float32)
    maps[1] = 4 * maps[1] - 1  # so that each threshold finds lines of its own
    return maps


def test_instances_stay_on_the_branch_map_and_are_numbered_by_their_scores():
    maps = noisy_maps()
    result, scores = found(maps, Grouping(least_pixels=20, least_length_px=4))
    assert len(scores) > 3
    assert result.label.max() == len(scores)
    assert (np.diff(scores) <= 0).all()
    assert not (result.label[maps[0] <= -0.85] > 0).any()


def test_strands_of_one_way_are_disjoint_and_none_comes_twice():
    candidates = candidates_of(noisy_maps(), Grouping(least_pixels=20, least_length_px=4))
    assert set(candidates.way) == set(range(5))
    assert len({cells.tobytes() for cells in candidates.cells}) == len(candidates.cells)
    for way in range(5):
        own = [c for c, w in zip(candidates.cells, candidates.way, strict=True) if w == way]
        together = np.concatenate(own)
        assert len(np.unique(together)) == len(together)


def test_a_line_that_is_weak_in_its_middle_is_two_strands_or_one_as_the_threshold_says():
    maps = perfect_maps(drawn([straight((160, 120), 0, 240, 7)]))
    maps[1, :, 72:88] = np.minimum(maps[1, :, 72:88], -1.0)  # a probability of .27
    way = candidates_of(maps, Grouping()).way
    assert [(way == k).sum() for k in (0, 3)] == [1, 2]


def overlapping():
    """Three strands on a grid of 4 x 10: the first nearly covers the second."""
    first, second, third = np.arange(8), np.arange(3, 9), np.arange(20, 30)
    return Candidates(size=(4, 10), cells=(first, second, third), way=np.array([0, 1, 0]))


def test_the_surest_is_taken_first_and_what_it_leaves_goes_to_the_others():
    maps = np.zeros((8, 4, 10), np.float32)
    result, scores = chosen(maps, overlapping(), np.array([0.9, 0.8, 0.95]), Grouping())
    assert scores.tolist() == [0.95, 0.9]  # one cell of six is not enough for the second
    assert (result.label.ravel()[20:30] == 1).all()
    assert (result.label.ravel()[:8] == 2).all()
    assert result.label.ravel()[8] == 0
    loose = Grouping(taken=0.9)
    result, scores = chosen(maps, overlapping(), np.array([0.9, 0.8, 0.95]), loose)
    assert scores.tolist() == [0.95, 0.9, 0.8]
    assert np.flatnonzero(result.label == 3).tolist() == [8]
    assert (result.label.ravel()[:8] == 2).all()
    result, scores = chosen(maps, overlapping(), np.array([0.7, 0.8, 0.95]), Grouping())
    assert scores.tolist() == [0.95, 0.8]  # three cells of eight is not enough for the first


def test_nothing_comes_of_nothing():
    for size in ((1, 1), (40, 60)):
        result, scores = found(np.full((8, *size), -5, np.float32), Grouping())
        assert scores.shape == (0,)
        assert result.label.shape == size
        assert not result.label.any()


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


def around_each(core):
    """The eight neighbours of each cell, from above on clockwise."""
    padded = np.pad(core, 1)
    steps = [(-1, 0), (-1, 1), (0, 1), (1, 1), (1, 0), (1, -1), (0, -1), (-1, -1)]
    height, width = core.shape
    return [padded[1 + i : 1 + i + height, 1 + j : 1 + j + width] for i, j in steps]


def joins_nothing(core):
    p2, p3, p4, p5, p6, p7, p8, p9 = around_each(core)
    corners = [~p2 & (p3 | p4), ~p4 & (p5 | p6), ~p6 & (p7 | p8), ~p8 & (p9 | p2)]
    one = sum(a.astype(int) for a in (p9 | p2, p3 | p4, p5 | p6, p7 | p8))
    two = sum(a.astype(int) for a in (p2 | p3, p4 | p5, p6 | p7, p8 | p9))
    least = np.minimum(one, two)
    return (sum(c.astype(int) for c in corners) == 1) & (least >= 2), least


def thinned_as_written(core):
    """Guo and Hall (1989), all cells at once in each half; then what joins nothing, in order."""
    core, before = core.copy(), None
    while before is None or not np.array_equal(core, before):
        before = core.copy()
        for second in (False, True):
            p2, p3, p4, p5, p6, p7, p8, p9 = around_each(core)
            stays = (p2 | p3 | ~p5) & p4 if second else (p6 | p7 | ~p9) & p8
            may, least = joins_nothing(core)
            core &= ~(may & (least <= 3) & ~stays)
    for i, j in np.argwhere(core):
        core[i, j] = not joins_nothing(core)[0][i, j]
    return core


@given(seed=st.integers(0, 10_000))
def test_thinning_takes_off_what_guo_and_hall_do(seed):
    core = blobs(seed)
    expected = thinned_as_written(core)
    cells = strands.thinned(core)
    assert np.array_equal(cells, np.argwhere(expected))
    assert np.array_equal(core, expected)


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
