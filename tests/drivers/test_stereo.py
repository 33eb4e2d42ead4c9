"""Depth from a pair: exact where the truth is exact, good enough on real and on thin things."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from canopy_skel.errors import UsageError
from canopy_skel.frame import Intrinsics, StereoPair, View
from canopy_skel.recording import read_recording
from drivers.stereo import StereoConfig, depth_from_stereo, with_depth

SHARED = Path(__file__).parents[2] / "../shared/data"


def pair_of(left, right, fx_px: float, baseline_m: float) -> StereoPair:
    height_px, width_px = left.shape
    lens = Intrinsics(
        fx_px=fx_px,
        fy_px=fx_px,
        cx_px=width_px / 2,
        cy_px=height_px / 2,
        width_px=width_px,
        height_px=height_px,
    )
    return StereoPair(left_mono=left, right_mono=right, intrinsics=lens, baseline_m=baseline_m)


def texture(height_px: int, width_px: int, seed: int) -> np.ndarray:
    noise = np.random.default_rng(seed).normal(size=(height_px, width_px)).astype(np.float32)
    smooth = cv2.GaussianBlur(noise, (0, 0), 1.0)
    return cv2.normalize(smooth, None, 20, 235, cv2.NORM_MINMAX).astype(np.uint8)


def wall_and_branch(wall_px: int = 12, branch_px: int = 30, width_px: int = 5) -> StereoPair:
    """Return a wall with a vertical branch before it: f * b = 60 px m."""
    wall, bark = texture(120, 320, 1), texture(120, width_px, 2)
    left, right = wall.copy(), np.roll(wall, -wall_px, axis=1)
    left[:, 150 : 150 + width_px] = bark
    right[:, 150 - branch_px : 150 - branch_px + width_px] = bark
    return pair_of(left, right, fx_px=600.0, baseline_m=0.1)


@pytest.mark.parametrize("all_directions", [True, False])
def test_a_thin_branch_before_a_wall_has_its_own_depth(all_directions):
    depth_m = depth_from_stereo(wall_and_branch(), StereoConfig(all_directions=all_directions))

    assert depth_m.dtype == np.float32
    wall, branch = depth_m[5:-5, 200:], depth_m[5:-5, 151:154]
    assert np.isfinite(wall).mean() > 0.95
    assert np.nanmedian(wall) == pytest.approx(60 / 12, rel=0.01)
    assert np.isfinite(branch).mean() > 0.9
    assert np.nanmedian(branch) == pytest.approx(60 / 30, rel=0.01)


def test_the_left_edge_is_not_lost():
    """Only what lies outside the right picture has no depth, not the whole disparity range."""
    depth_m = depth_from_stereo(wall_and_branch(wall_px=12))
    assert np.isnan(depth_m[:, :11]).all()
    assert np.isfinite(depth_m[5:-5, 20:100]).mean() > 0.95


def test_nothing_outside_the_range_of_depths_is_claimed():
    pair = wall_and_branch()
    depth_m = depth_from_stereo(pair, StereoConfig(nearest_m=0.5, farthest_m=4.0))
    assert np.nanmax(depth_m) <= 4.0
    assert np.nanmin(depth_m) >= 0.5
    assert np.isfinite(depth_m[:, 200:]).mean() < 0.02


def test_a_picture_without_texture_has_no_wrong_depth():
    grey = np.full((60, 160), 128, np.uint8)
    depth_m = depth_from_stereo(pair_of(grey, grey, 600.0, 0.1))
    assert np.isnan(depth_m).all()


def test_a_view_gets_depth_only_if_it_has_none():
    pair = wall_and_branch()
    grey = np.repeat(pair.left_mono[..., None], 3, axis=2)
    view = View(
        index=0, stamp_ns=0, color_rgb=grey, intrinsics=pair.intrinsics, base_from_camera=np.eye(4)
    )
    assert with_depth(view) is view
    seen = with_depth(replace(view, stereo=pair))
    np.testing.assert_array_equal(seen.depth_m, depth_from_stereo(pair))
    assert seen.matched
    assert with_depth(seen) is seen


@pytest.mark.parametrize(
    "changes", [{"nearest_m": 0.0}, {"nearest_m": 11.0}, {"window_px": 4}, {"window_px": 0}]
)
def test_settings_that_make_no_sense(changes):
    with pytest.raises(UsageError, match="stereo"):
        StereoConfig(**changes)


def test_real_plant_with_measured_disparity():
    left, right, truth_px = (
        cv2.imread(str(SHARED / "stereo" / name), cv2.IMREAD_GRAYSCALE)
        for name in ("aloeL.jpg", "aloeR.jpg", "aloeGT.png")
    )
    if left is None or right is None or truth_px is None:
        pytest.skip("aloe stereo pair is not there (shared data folder)")
    # Half the size keeps the test quick; f * b = 1, so depth is 1 / disparity.
    half = (left.shape[1] // 2, left.shape[0] // 2)
    left, right = (cv2.resize(one, half, interpolation=cv2.INTER_AREA) for one in (left, right))
    truth_px = cv2.resize(truth_px, half, interpolation=cv2.INTER_NEAREST).astype(np.float32) / 2
    config = StereoConfig(nearest_m=1 / 112, farthest_m=1.0)

    disparity_px = 1 / depth_from_stereo(pair_of(left, right, 1.0, 1.0), config)

    known = truth_px > 0
    found = known & np.isfinite(disparity_px)
    error_px = np.abs(disparity_px - truth_px)[found]
    assert found.sum() / known.sum() > 0.85
    assert (error_px > 2).mean() < 0.04
    assert np.median(error_px) < 0.25


def test_recorded_branches_get_depth_where_the_tree_is():
    path = SHARED / "recordings/walnut_stereo.mcap"
    if not path.exists():
        pytest.skip("walnut_stereo.mcap is not there (shared data folder)")
    view = with_depth(next(read_recording(path).views()))
    branches_m = view.depth_m[view.instances > 0]
    assert np.isfinite(branches_m).mean() > 0.75
    assert np.nanpercentile(branches_m, [5, 95]) == pytest.approx([1.1, 1.8], abs=0.4)
