import numpy as np
import pytest

from mock_hw.orchard.mesh import Kind
from mock_hw.orchard.sensor import StereoNoise, TrueDepth, perfect_depth, stereo_depth

FB = 66.0
SHAPE = (300, 400)


def wall(kind, depth_m=1.3, thin=False):
    depth = np.full(SHAPE, depth_m)
    return TrueDepth(
        left_m=depth,
        right_m=depth,
        kind=np.full(SHAPE, kind, dtype=np.uint8),
        thin=np.full(SHAPE, thin),
        focal_baseline=FB,
    )


def disparity_error(true, rng):
    return FB / stereo_depth(true, rng).astype(float)[:, 100:] - (FB / true.left_m)[:, 100:]


@pytest.mark.parametrize(("kind", "sigma"), [(Kind.WOOD, 0.25), (Kind.LEAF, 0.4)])
def test_disparity_noise_has_the_strength_of_its_surface_and_no_bias(kind, sigma, rng):
    error = disparity_error(wall(kind), rng)
    assert np.nanstd(error) == pytest.approx(np.hypot(sigma, 0.125 / np.sqrt(12)), rel=0.06)
    assert abs(np.nanmean(error)) < 0.02


def test_noise_is_correlated_over_the_window_and_not_beyond(rng):
    error = disparity_error(wall(Kind.LEAF), rng)

    def correlation(shift):
        a, b = error[:, shift:], error[:, : error.shape[1] - shift]
        both = np.isfinite(a) & np.isfinite(b)
        return np.corrcoef(a[both], b[both])[0, 1]

    assert correlation(1) == pytest.approx(0.8, abs=0.06)
    assert correlation(3) == pytest.approx(0.4, abs=0.08)
    assert abs(correlation(7)) < 0.08


def test_disparity_comes_in_eighths_of_a_pixel(rng):
    steps = FB / stereo_depth(wall(Kind.WOOD), rng).astype(float) * 8
    steps = steps[np.isfinite(steps)]
    assert np.abs(steps - np.rint(steps)).max() < 1e-3


@pytest.mark.parametrize(("thin", "share"), [(False, 0.05), (True, 0.15)])
def test_holes_take_their_share_in_blobs(thin, share, rng):
    holes = np.isnan(stereo_depth(wall(Kind.WOOD, thin=thin), rng))[:, 100:]
    assert holes.mean() == pytest.approx(share, rel=0.25)
    beside = holes[:, 1:][holes[:, :-1]].mean()
    assert beside > 3 * share


@pytest.mark.parametrize("depth_m", [0.3, 25.0])
def test_nothing_is_returned_out_of_range(depth_m, rng):
    assert np.isnan(stereo_depth(wall(Kind.WOOD, depth_m), rng)).all()


def near_square(background_m=2.2):
    """A square at 1.1 m, columns 200..299 of the left eye, seen 60 px further left by the right."""
    left, right = np.full(SHAPE, background_m), np.full(SHAPE, background_m)
    left[100:200, 200:300] = 1.1
    right[100:200, 140:240] = 1.1
    kind = np.full(SHAPE, Kind.SKY if np.isinf(background_m) else Kind.LEAF, dtype=np.uint8)
    kind[100:200, 200:300] = Kind.WOOD
    return TrueDepth(
        left_m=left, right_m=right, kind=kind, thin=np.zeros(SHAPE, bool), focal_baseline=FB
    )


def test_what_the_right_eye_cannot_see_has_no_depth(rng):
    depth = stereo_depth(near_square(), rng)
    hidden, open_background = depth[105:195, 172:196], depth[105:195, 130:165]
    assert np.isnan(hidden).mean() > 0.95
    assert np.isnan(open_background).mean() < 0.15
    assert np.isnan(depth[:, :28]).all()


def test_near_surfaces_grow_by_three_pixels_in_half_of_the_pixels(rng):
    depth = stereo_depth(near_square(), rng)
    rim, beyond = depth[105:195, 300:303], depth[105:195, 304:320]
    valid = np.isfinite(rim)
    assert (np.abs(rim[valid] - 1.1) < 0.1).mean() == pytest.approx(0.5, abs=0.1)
    between = (rim[valid] > 1.2) & (rim[valid] < 2.0)
    assert 0.005 < between.mean() < 0.1
    assert (np.abs(beyond[np.isfinite(beyond)] - 2.2) < 0.3).all()


def test_a_quarter_of_the_sky_beside_foliage_gets_a_false_depth(rng):
    depth = stereo_depth(near_square(np.inf), rng)
    rim = depth[105:195, 300:303]
    assert np.isfinite(rim).mean() == pytest.approx(0.25, abs=0.07)
    assert np.nanmedian(rim) == pytest.approx(1.1, abs=0.05)
    assert np.isnan(depth[105:195, 304:]).all()


def test_the_same_seed_gives_the_same_depth():
    first, second = (
        stereo_depth(near_square(), np.random.default_rng(4), StereoNoise()) for _ in range(2)
    )
    assert first.tobytes() == second.tobytes()
    assert first.dtype == np.float32


def test_perfect_depth_has_no_return_in_the_sky():
    depth = perfect_depth(np.array([[1.5, np.inf]]))
    assert depth[0, 0] == 1.5
    assert np.isnan(depth[0, 1])
