"""What is worked out of whole pictures, beside the library's way to do it."""

import cv2
import numpy as np
import pytest
from scenes.wood import view_from
from scipy.ndimage import gaussian_filter

from canopy_skel import wood
from canopy_skel.components import painted, pixels_of, runs_of
from canopy_skel.evidence import BACKGROUND, HIDDEN, LEAF, THROUGH, UNKNOWN, WOOD, evidence_of
from canopy_skel.kernels import around, colours, verdicts
from canopy_skel.wood import FragmentConfig, asked_pixels, fragments_of
from canopy_skel.woodpixels import PixelModel, figures_of

SHAPES = [(40, 60), (41, 57), (1, 9), (9, 1)]


def noise(shape, share, seed=0):
    picture = np.random.default_rng(seed).random(shape)
    return cv2.blur(picture, (3, 3)) < np.quantile(picture, share)


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("share", [0.0, 0.3, 0.5, 0.8, 1.0])
def test_components_are_those_of_the_library(shape, share):
    mask = noise(shape, share) if 0 < share < 1 else np.full(shape, share > 0)
    count, labels = cv2.connectedComponents(mask.astype(np.uint8), connectivity=8)
    runs = runs_of(mask)
    assert len(np.unique(runs.component)) == count - 1
    row, column = pixels_of(runs, np.arange(len(runs.row)))
    np.testing.assert_array_equal(np.argwhere(mask), np.column_stack([row, column]))
    of = np.repeat(runs.component, runs.length)
    assert len(np.unique(np.column_stack([of, labels[mask]]), axis=0)) == count - 1
    np.testing.assert_array_equal(np.repeat(runs.area, runs.length), np.bincount(of)[of])
    large = runs.area > 20
    np.testing.assert_array_equal(
        painted(runs, large, shape), mask & (np.bincount(labels.ravel())[labels] > 20)
    )


@pytest.mark.parametrize("seed", range(4))
def test_fragments_come_in_the_order_of_the_librarys_labels(seed):
    probability = np.where(noise((60, 81), 0.45, seed), np.float32(0.8), np.float32(0.1))
    config = FragmentConfig(min_probability=0.5, min_px=3, max_px=200)
    found = fragments_of(probability, np.zeros((5, 30, 41), np.float32), config)
    _, labels, stats, _ = cv2.connectedComponentsWithStats((probability > 0.5).astype(np.uint8))
    area = stats[1:, cv2.CC_STAT_AREA]
    kept = 1 + np.flatnonzero((area >= 3) & (area <= 200))
    assert len(kept) > 5
    np.testing.assert_array_equal(np.diff(found.start), area[kept - 1])
    for i, label in enumerate(kept):
        own = slice(found.start[i], found.start[i + 1])
        np.testing.assert_array_equal(
            np.column_stack([found.v[own], found.u[own]]), np.argwhere(labels == label)
        )


@pytest.mark.parametrize("shape", [(40, 60), (41, 57), (3, 5), (1, 1)])
@pytest.mark.parametrize("missing", [0.0, 0.4, 1.0])
def test_depths_around_a_pixel_are_the_least_and_largest_in_its_window(shape, missing):
    random = np.random.default_rng(1)
    depth_m = random.uniform(0.5, 3, shape).astype(np.float32)
    depth_m[random.random(shape) < missing] = np.nan
    depth_m[random.random(shape) < 0.05] = np.inf
    range_m, shows = verdicts.depth_ranges(depth_m, 2, 2, 16)
    for (row, column), flag in np.ndenumerate(shows):
        v, u = 2 * row, 2 * column
        window = depth_m[max(v - 2, 0) : v + 3, max(u - 2, 0) : u + 3]
        some = window[np.isfinite(window)]
        at_rim = window.size < 25
        none = np.finfo(np.float32).max if at_rim else np.inf
        assert range_m[row, column, 0] == some.min(initial=none)
        assert range_m[row, column, 1] == some.max(initial=-none)
        if not at_rim:
            assert flag == (len(some) > 15)


def test_verdicts_are_those_of_a_loop_over_the_points():
    view = view_from(0, y=0.03)
    random = np.random.default_rng(2)
    depth_m = view.depth_m.copy()
    depth_m[40:120, 60:220][random.random((80, 160)) < 0.2] = 0.7  # leaves
    evidence = evidence_of(
        type(view)(
            index=0,
            stamp_ns=0,
            color_rgb=view.color_rgb,
            intrinsics=view.intrinsics,
            base_from_camera=view.base_from_camera,
            depth_m=depth_m,
        ),
        view.instances > 0,
    )
    points = random.uniform([-0.2, -0.6, -0.6], [2.0, 0.6, 0.6], (4000, 3))
    counts = np.zeros((len(points), 6), np.int64)
    evidence.count(points, counts)
    expected = np.array([naive_verdict(evidence, point) for point in points])
    assert set(expected) == {UNKNOWN, THROUGH, BACKGROUND, WOOD, LEAF, HIDDEN}
    np.testing.assert_array_equal(counts, np.eye(6, dtype=np.int64)[expected])
    evidence.count(points, counts, times=-1)
    assert not counts.any()


def naive_verdict(evidence, point):
    x, y, z = (evidence.camera_from_base @ [*point, 1.0])[:3]
    if z <= 0.05:
        return UNKNOWN
    camera, (height, width) = evidence.intrinsics, evidence.shows.shape
    u = int(np.floor((camera.fx_px * x / z + camera.cx_px) / 2 + 0.5))
    v = int(np.floor((camera.fy_px * y / z + camera.cy_px) / 2 + 0.5))
    if not (0 <= u < width and 0 <= v < height):
        return UNKNOWN
    nearest, farthest = evidence.range_m[v, u].astype(np.float64)
    shows, margin = int(evidence.shows[v, u]), 0.025 + 0.012 * z**2
    if shows & verdicts.SHOWS_DENSE and np.isfinite(nearest) and nearest > z + margin:
        return THROUGH
    if shows & verdicts.SHOWS_BACKGROUND:
        return BACKGROUND
    if nearest <= z + margin and farthest >= z - margin:
        return WOOD if shows & verdicts.SHOWS_WOOD else LEAF
    return HIDDEN if np.isfinite(farthest) and farthest < z - margin else UNKNOWN


@pytest.mark.parametrize("count", [1, 2000])
def test_colours_spread_as_if_all_of_them_were_worked_through(count):
    random = np.random.default_rng(3)
    bins = (random.normal(0.5, 0.15, (count, 3)).clip(0, 0.999) * [32, 64, 64]).astype(np.int64)
    flat = np.ravel_multi_index(tuple(bins.T), (32, 64, 64))
    counts = np.bincount(flat, minlength=1 << 17).reshape(32, 64, 64).astype(np.float64)
    expected = gaussian_filter(counts, 1.0, mode="nearest")
    np.testing.assert_array_equal(wood._spread(np.bincount(flat, minlength=1 << 17)), expected)


def test_colours_are_counted_and_looked_up_by_bins_of_8_and_4_levels():
    random = np.random.default_rng(4)
    lab = random.integers(0, 256, (30, 41, 3), dtype=np.uint8)
    lab[:20] //= 16
    chosen, split = random.random((2, 30, 41)) < 0.6
    bins = np.ravel_multi_index(tuple(np.moveaxis(lab // [8, 4, 4], 2, 0)), (32, 64, 64))
    counts = colours.count_colours(lab, chosen, split)
    for row, flag in zip(counts, (split, ~split), strict=True):
        np.testing.assert_array_equal(row, np.bincount(bins[chosen & flag], minlength=1 << 17))
    table = random.random(1 << 17, dtype=np.float32)
    np.testing.assert_array_equal(colours.look_up(lab, table), table[bins])


def test_pixels_are_asked_where_the_network_sees_any_wood_around():
    hints = np.full((2, 4, around.HINTS), -8.0, np.float32)  # each cell stands for 3 x 3 pixels
    hints[:, 1:, 3], hints[:, 3, 0] = -1.0, 2.0
    mean_odds = np.full((6, 12), -3.0, np.float32)
    mean_odds[1], mean_odds[2] = 0.5, -np.inf
    v, u = asked_pixels(mean_odds, hints, FragmentConfig())
    by_network = {(v, u) for v in (0, 1, 3, 4, 5) for u in (9, 10, 11)}
    by_colour = {(1, u) for u in range(3, 12)}
    assert set(zip(v.tolist(), u.tolist(), strict=True)) == by_network | by_colour


@pytest.mark.parametrize(
    "wrong", [{"first": (51, 3)}, {"first": (56, 2)}, {"first_bias": 4}, {"second": 2}]
)
def test_a_model_fitted_to_other_figures_is_refused(wrong):
    shapes = {"first": (around.FIGURES, 3), "first_bias": 3, "second": 3}
    arrays = {name: np.zeros(shape, np.float32) for name, shape in (shapes | wrong).items()}
    model = PixelModel(**arrays, second_bias=0.0, provenance="")
    layers, one = np.zeros((4, 4, 4), np.float32), np.ones(1, np.int64)
    hints = np.zeros((2, 2, around.HINTS), np.float32)
    with pytest.raises(ValueError, match="fit it again"):
        model.probability(layers, hints, np.zeros(1, np.float32), one, one)


@pytest.mark.parametrize("grid", [(20, 30), (50, 75), (40, 60), (1, 1)])
def test_hints_are_read_between_the_cells_of_their_own_grid(grid):
    height, width = 40, 60
    v, u = (np.array(one) for one in ([0, 7, 21, 39], [59, 3, 30, 0]))
    row, column = np.mgrid[: grid[0], : grid[1]] + 0.5
    ramp = np.stack([row / grid[0], column / grid[1], *[np.ones(grid)] * 3], axis=-1)
    layers, odds = np.zeros((height, width, 4), np.float32), np.zeros(4, np.float32)
    found = figures_of(layers, ramp.astype(np.float32), odds, v, u)[:, 3 : around.OWN]
    places = ((v + 0.5) / height, (u + 0.5) / width)
    for column, (place, count) in enumerate(zip(places, grid, strict=True)):
        expected = place.clip(0.5 / count, 1 - 0.5 / count)
        np.testing.assert_allclose(found[:, column], expected, atol=1e-6)
    np.testing.assert_allclose(found[:, 2:], 1)
