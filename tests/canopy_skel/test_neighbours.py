"""Kernels that look for neighbours cell by cell, beside loops over everything there is."""

import numpy as np
import pytest

from canopy_skel.fusion import FusionConfig, Observations, fuse
from canopy_skel.kernels import agree, aligning
from canopy_skel.kernels import fuse as kernel

CELL_M = 0.024
WIDTH_M = 0.012
MIN_COSINE = 0.5


def twigs(seed, count=400):
    """Return points along some lines across the origin, so that cells of all signs hold them."""
    random = np.random.default_rng(seed)
    ways = unit(random.normal(size=(6, 3)))
    of = random.integers(0, 6, count)
    points = random.uniform(-0.15, 0.15, (count, 1)) * ways[of]
    points += random.normal(0, 0.004, points.shape)
    return points, unit(ways[of] + random.normal(0, 0.3, points.shape)), random


def unit(vectors):
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def by_cell(points, cell_m):
    keys = kernel.cell_keys(points, cell_m)
    order = np.argsort(keys, kind="stable")
    return order, keys[order]


@pytest.mark.parametrize("seed", range(3))
def test_points_move_to_the_mean_of_all_that_run_along_them(seed):
    points, directions, random = twigs(seed)
    order, keys = by_cell(points, CELL_M)
    references, ways = points[order], directions[order]
    radii, probable, weights = random.uniform(0.002, 0.06, (3, len(points)))
    probability = random.uniform(0.5, 1, len(points))
    bits = 1 << random.integers(0, 5, len(points))
    fragment = random.random(len(points)) < 0.4
    moved, turned, support = kernel.shift_across(
        points, directions, radii, references, ways, radii, probable, weights, probability, bits,
        fragment, keys, CELL_M, WIDTH_M, 0.5, MIN_COSINE,
    )  # fmt: skip
    for i, (point, way) in enumerate(zip(points, directions, strict=True)):
        width = max(WIDTH_M, 0.5 * radii[i])
        offset, cosine = references - point, ways @ way
        squared = np.sum(offset**2, axis=1)
        near = (squared <= (2 * width) ** 2) & (np.abs(cosine) >= MIN_COSINE)
        weight = (weights * np.exp(-0.5 * squared / width**2))[near]
        mean = weight @ offset[near] / weight.sum()
        heading = weight @ (np.sign(cosine[near])[:, None] * ways[near])
        heading /= np.linalg.norm(heading)
        np.testing.assert_allclose(moved[i], point + mean - (mean @ heading) * heading, atol=1e-12)
        np.testing.assert_allclose(turned[i], heading, atol=1e-12)
        expected = [
            weight.sum(),
            weight @ radii[near] / weight.sum(),
            weight @ probability[near] / weight.sum(),
            probability[near].max(),
            int(np.bitwise_or.reduce(bits[near])).bit_count(),
            weight @ ~fragment[near] / weight.sum(),
            weight @ probable[near] / weight.sum(),
        ]
        np.testing.assert_allclose(support[i], expected, rtol=1e-12)


def test_the_spread_around_points_is_that_of_all_within_reach():
    points, directions, random = twigs(5)
    order, keys = by_cell(points, CELL_M)
    points, directions = points[order], directions[order]
    weights, chosen = random.uniform(0.1, 1, len(points)), np.arange(0, len(points), 7)
    found = kernel.spread_around(chosen, directions, points, weights, keys, CELL_M, WIDTH_M, 0.075)
    for covariance, i in zip(found, chosen, strict=True):
        offset = points - points[i]
        squared = np.sum(offset**2, axis=1)
        near = squared <= (2 * WIDTH_M) ** 2
        weight = (weights * np.exp(-0.5 * squared / WIDTH_M**2))[near]
        expected = np.cov(offset[near].T, aweights=weight, ddof=0)
        expected += 0.075 * WIDTH_M**2 * np.outer(directions[i], directions[i])
        np.testing.assert_allclose(covariance, expected, atol=1e-15)


@pytest.mark.parametrize("cell_m", [0.003, 0.006, 0.02])
def test_thinning_keeps_in_order_what_no_kept_point_is_near(cell_m):
    points, _, random = twigs(7)
    order, keys = by_cell(points, cell_m)
    points, first = points[order], random.permutation(len(points))
    kept = []
    for i in first:
        if all(np.sum((points[i] - points[j]) ** 2) > 0.006**2 for j in kept):
            kept.append(i)
    found = kernel.thinned(points, first, keys, cell_m, 0.006)
    np.testing.assert_array_equal(np.flatnonzero(found), np.sort(kept))


def test_agreement_is_with_any_point_near_and_along():
    points, directions, random = twigs(11)
    others, ways, _ = twigs(11, 300)
    order, keys = by_cell(others, 0.02)
    others, ways = others[order], ways[order]
    fragment = random.random(len(others)) < 0.5
    found = agree.agreement(
        points, directions, others, ways, fragment, keys, 0.02, 0.012, 0.02, 0.82
    )
    offset = others - points[:, None]
    squared, along = np.sum(offset**2, axis=2), np.einsum("pri,pi->pr", offset, directions)
    near = (squared <= 0.02**2) & (squared - along**2 <= 0.012**2)
    parallel = near & (np.abs(directions @ ways.T) >= 0.82)
    expected = np.column_stack(
        [near.any(axis=1), (parallel & ~fragment).any(axis=1), (parallel & fragment).any(axis=1)]
    )
    assert 0 < expected.mean() < 1
    np.testing.assert_array_equal(found, expected)


def test_points_lie_off_the_nearest_vertex_that_runs_along_them():
    points, directions, _ = twigs(13)
    vertices, ways, _ = twigs(14, 120)
    order, keys = by_cell(vertices, 0.03)
    vertices, ways = vertices[order], ways[order]
    near, index, off = aligning.offsets(points, directions, vertices, ways, keys, 0.03, 0.9)
    distance = np.linalg.norm(points[:, None] - vertices, axis=2)
    nearest = distance.argmin(axis=1)
    along = np.abs(np.sum(directions * ways[nearest], axis=1)) > 0.9
    expected = np.flatnonzero(along & (distance.min(axis=1) < 0.03))
    assert 0 < len(expected) < len(points)
    np.testing.assert_array_equal(near, expected)
    np.testing.assert_array_equal(index, nearest[expected])
    there, way = vertices[index] - points[near], ways[index]
    across = there - np.sum(there * way, axis=1, keepdims=True) * way
    np.testing.assert_allclose(off, across, atol=1e-15)


def all_found(points, directions, random):
    """Return what every kernel that looks for neighbours finds, in the order of the points."""
    order, keys = by_cell(points, CELL_M)
    places, ways, place = points[order], directions[order], np.argsort(order)
    radii, weights = random.uniform(0.002, 0.06, (2, len(points)))
    fragment, kept = random.random(len(points)) < 0.5, np.zeros(len(points), np.bool_)
    bits = np.ones(len(points), np.int64)
    near = (
        places,
        ways,
        *(one[order] for one in (radii, radii, weights, weights, bits, fragment)),
        keys,
    )
    shifted = kernel.shift_across(points, directions, radii, *near, CELL_M, WIDTH_M, 0.5, 0.5)
    kept[order] = kernel.thinned(places, place, keys, CELL_M, 0.006)
    return {
        "support": shifted[2],
        "spread": kernel.spread_around(
            place, ways, places, weights[order], keys, CELL_M, WIDTH_M, 0.075
        ),
        "thinned": kept,
        "agreed": agree.agreement(
            points, directions, places, ways, fragment[order], keys, CELL_M, 0.012, 0.02, 0.82
        ),
        "along": aligning.offsets(points, directions, places, ways, keys, CELL_M, 0.9)[0],
    }


@pytest.mark.parametrize("away_m", [(0, 3e4, 0), (0, 0, -9e4), (-9e4, 9e4, 9e4), (1e5, -8e3, 1e5)])
def test_neighbours_are_the_same_however_far_off_base_is(away_m):
    points, directions, _ = twigs(23)
    here = all_found(points, directions, np.random.default_rng(0))
    there = all_found(points + away_m, directions, np.random.default_rng(0))
    for name in here:
        assert here[name].any()
        np.testing.assert_allclose(there[name], here[name], rtol=1e-7, atol=1e-9, err_msg=name)


def test_a_shift_and_a_turn_are_found_again():
    points, directions, random = twigs(17)
    shift, turn = random.normal(0, 0.01, (2, 3))
    moved = shift + np.cross(turn, points)
    off = moved - np.sum(moved * directions, axis=1, keepdims=True) * directions
    weights = random.uniform(0.5, 2, len(points))
    equations = aligning.normal_equations(points, off, directions, weights)
    np.testing.assert_allclose(equations[:, :6], equations[:, :6].T, atol=1e-9)
    step = np.linalg.solve(equations[:, :6], equations[:, 6])
    np.testing.assert_allclose(step, [*shift, *turn], atol=1e-9)


def test_vertices_keep_the_order_of_the_points_that_gave_them():
    points, directions, _ = twigs(19)
    points += np.linspace(0, 4, len(points))[:, None] * [0, 0, 1]  # far apart: each its own vertex
    seen = Observations(
        points_in_base=points,
        directions=directions,
        radius_m=np.full(len(points), 0.004),
        probable_radius_m=np.full(len(points), 0.004),
        probability=np.full(len(points), 0.9),
        view=np.zeros(len(points), np.int64),
        fragment=np.zeros(len(points), np.bool_),
    )
    fused = fuse(seen, FusionConfig())
    nearest = [np.linalg.norm(points - v, axis=1).argmin() for v in fused.vertices_in_base]
    assert len(nearest) > 100
    assert (np.diff(nearest) > 0).mean() > 0.95
