import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.interpolate import make_lsq_spline

from canopy_skel.cluster import BranchCluster, principal_axes
from canopy_skel.spline import SplineConfig, directions_across, fit_splines

LITERAL = SplineConfig(centre_shift=0.0, radius="extent")


def cluster_of(points, camera=(0.0, 0.0, -1.0), half_width_m=0.004):
    return BranchCluster(
        view_index=0,
        instance=1,
        confidence=0.8,
        half_width_m=half_width_m,
        camera_in_base=np.array(camera),
        points_in_base=np.asarray(points, float),
    )


def fit_spline(cluster, config):
    return fit_splines([cluster], config)[0]


def front_of_cylinder(radius_m, seed=0, count=4000):
    """What a camera far away along -z sees of a cylinder along x at the origin."""
    random = np.random.default_rng(seed)
    across = random.uniform(-radius_m, radius_m, count)
    depth = -np.sqrt(radius_m**2 - across**2)
    return np.stack([random.uniform(-0.1, 0.1, count), across, depth], axis=1)


@given(st.integers(0, 2**32 - 1), st.integers(40, 400))
def test_control_points_are_those_of_the_library(seed, count):
    random = np.random.default_rng(seed)
    along = np.sort(random.uniform(0, 0.2, count))
    points = np.stack([along, 0.3 * along**2, -0.1 * along], axis=1)
    points += random.normal(0, 0.002, points.shape)
    spline = fit_spline(cluster_of(points), LITERAL)
    _, axes = principal_axes(points)
    t = (points - points.mean(axis=0)) @ axes[0]
    order = np.argsort(t)
    knots = np.linspace(t.min(), t.max(), 4)
    expected = make_lsq_spline(t[order], points[order], np.r_[knots[0], knots, knots[-1]], k=1)
    np.testing.assert_allclose(spline.control_points_in_base, expected.c, atol=1e-9)


def test_radius_is_the_papers_half_extent_along_pc2():
    points = front_of_cylinder(0.01)
    spline = fit_spline(cluster_of(points), LITERAL)
    assert spline.radius_m == pytest.approx(0.01, rel=0.02)


@pytest.mark.parametrize("radius_m", [0.003, 0.012, 0.045])
def test_the_surface_is_moved_to_the_centre_line(radius_m):
    points = front_of_cylinder(radius_m)
    spline = fit_spline(cluster_of(points, half_width_m=radius_m), SplineConfig())
    assert spline.radius_m == radius_m
    off = np.linalg.norm(spline.control_points_in_base[:, 1:], axis=1)
    assert off.max() < 0.15 * radius_m


def test_depth_noise_enters_the_papers_radius_only():
    points = front_of_cylinder(0.004)
    points[:, 2] += np.random.default_rng(1).normal(0, 0.006, len(points))
    assert fit_spline(cluster_of(points), SplineConfig()).radius_m == 0.004
    assert fit_spline(cluster_of(points), LITERAL).radius_m > 0.015


def test_an_empty_span_means_fewer_control_points():
    along = np.r_[np.linspace(0, 0.001, 50), np.linspace(0.199, 0.2, 50)]
    points = np.stack([along, 0.01 * along, np.zeros(100)], axis=1)
    spline = fit_spline(cluster_of(points), LITERAL)
    assert len(spline.control_points_in_base) == 2
    np.testing.assert_allclose(spline.control_points_in_base[:, 0], [0.0, 0.2], atol=1e-4)


def test_points_in_three_rows_do_not_tell_four_control_points_apart():
    for middle in (0.0, 1e-3, -2e-3):
        x = np.repeat([-0.02, middle, 0.02], 8)
        points = np.column_stack([x, np.tile(np.arange(8.0) / 1000, 3), np.zeros(24)])
        spline = fit_spline(cluster_of(points), LITERAL)
        assert len(spline.control_points_in_base) == 3
        np.testing.assert_allclose(spline.control_points_in_base[[0, 2], 0], [-0.02, 0.02])
        np.testing.assert_allclose(spline.control_points_in_base[:, 1], 0.0035, atol=1e-9)


def test_points_that_are_all_one_give_a_spline_without_length():
    spline = fit_spline(cluster_of(np.full((1000, 3), 0.1)), LITERAL)
    np.testing.assert_allclose(spline.control_points_in_base, np.full((2, 3), 0.1))


@given(st.integers(0, 2**32 - 1))
def test_a_rigid_motion_moves_the_spline(seed):
    random = np.random.default_rng(seed)
    points = random.normal(size=(200, 3)) * [0.1, 0.006, 0.004]
    rotation, _ = np.linalg.qr(random.normal(size=(3, 3)))
    rotation *= np.sign(np.linalg.det(rotation))
    shift = random.uniform(-1, 1, 3)
    here = fit_spline(cluster_of(points), SplineConfig())
    camera = rotation @ np.array([0.0, 0.0, -1.0]) + shift
    there = fit_spline(cluster_of(points @ rotation.T + shift, camera), SplineConfig())
    moved = here.control_points_in_base @ rotation.T + shift
    either = [there.control_points_in_base, there.control_points_in_base[::-1]]
    assert min(np.abs(moved - e).max() for e in either) < 1e-8
    assert there.radius_m == pytest.approx(here.radius_m, abs=1e-9)


def test_a_branch_that_points_at_the_camera_has_a_direction_across():
    across = directions_across(np.array([[0.0, 0.0, 2.0]]), np.array([[0.0, 0.0, 1.0]]))[0]
    assert across @ [0, 0, 1] == pytest.approx(0.0)
    assert np.linalg.norm(across) == pytest.approx(1.0)


def test_a_batch_gives_what_each_cluster_alone_gives():
    clusters = [cluster_of(front_of_cylinder(r, count=n)) for r, n in ((0.003, 40), (0.02, 900))]
    for one, spline in zip(clusters, fit_splines(clusters, SplineConfig()), strict=True):
        alone = fit_spline(one, SplineConfig())
        assert alone.control_points_in_base.tobytes() == spline.control_points_in_base.tobytes()
        assert alone.radius_m == spline.radius_m


def test_no_cluster_no_spline():
    assert fit_splines([], SplineConfig()) == []
