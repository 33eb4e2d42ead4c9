"""Recordings that nobody here made: every view reads, and the truth falls where it should."""

import json
from pathlib import Path

import numpy as np
import pytest

from canopy_skel.frame import View
from canopy_skel.geometry import invert, transform_points
from canopy_skel.recording import read_recording

FOLDER = Path(__file__).parents[3] / "../shared/data/recordings"


def recording(name: str):
    path = FOLDER / f"{name}.mcap"
    if not path.exists():
        pytest.skip(f"{path.name} is not there (shared data folder)")
    return read_recording(path)


@pytest.mark.parametrize("name", ["apple_fd2", "oak_fd3", "apple_dense", "walnut_stereo"])
def test_every_view_reads_and_the_truth_projects_onto_the_masks(name):
    scan = recording(name)
    truth = json.loads(scan.ground_truth)["vertices"]
    points_in_base = np.array(truth["position"])
    segmented = np.array(truth["segmented"], dtype=bool)
    radius_m = np.array(truth["radius"])
    on_mask = np.zeros(len(points_in_base), dtype=bool)
    behind_surface_m = []
    for view in scan.views():
        assert isinstance(view, View)
        assert (view.stereo is not None) == (name == "walnut_stereo") == (view.depth_m is None)
        assert view.instances.max() == len(view.scores)
        in_camera = transform_points(invert(view.base_from_camera), points_in_base)
        uv = np.rint(view.intrinsics.project(in_camera)).astype(int)
        height_px, width_px = view.instances.shape
        inside = (in_camera[:, 2] > 0) & (uv >= 0).all(axis=1) & (uv < (width_px, height_px)).all(1)
        hit = np.flatnonzero(inside)[view.instances[uv[inside, 1], uv[inside, 0]] > 0]
        on_mask[hit] = True
        if view.depth_m is not None:
            depth_m = view.depth_m[uv[hit, 1], uv[hit, 0]]
            behind_surface_m.append(in_camera[hit, 2] - radius_m[hit] - depth_m)

    assert (scan.view_count, scan.warnings, scan.scan_id) == (10, (), name)
    assert on_mask[segmented].mean() > 0.9
    if behind_surface_m:
        assert abs(np.nanmedian(np.concatenate(behind_surface_m))) < 0.006
