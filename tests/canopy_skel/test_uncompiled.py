"""Numba compiles what it understands; Python runs what is written: both must do the same."""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).parents[2]
SMALL = (
    "test_kernels.py",
    "test_neighbours.py",
    "test_pictures.py",
    "test_slivers.py::test_bark_between_places_where_the_trunk_is_seen_whole_moves_onto_its_axis",
    "test_volume.py::test_wood_drawn_twice_counts_once",
    "test_spline.py::test_radius_is_the_papers_half_extent_along_pc2",
    "segmenters/test_labels.py::test_targets_say_where_branches_are_how_they_run_and_how_thick",
    "segmenters/test_grouping.py::test_branches_that_touch_side_by_side_are_two",
    "segmenters/test_scorer.py::test_a_strip_is_looked_up_between_cells",
    "segmenters/test_scorer.py::test_a_mirrored_strip_is_the_strip_of_a_mirrored_picture",
    "segmenters/test_grouping.py::test_at_a_fork_the_straightest_way_goes_on",
)
CANOPY = """
import json, sys
sys.path.insert(0, "tests")
from scenes.leaves import leafy_view
from canopy_skel.pipeline import MethodConfig, Skeletonizer
from canopy_skel.segmenters.recorded import RecordedSegmenter
maker = Skeletonizer(RecordedSegmenter(), MethodConfig(name="canopy"))
for index in range(2):
    maker.add_view(leafy_view(index, y=0.1 * index))
graph = maker.skeleton().graph
print(json.dumps([graph.vertices_in_base.tolist(), graph.edges.tolist()]))
"""


def uncompiled(*arguments):
    done = subprocess.run(
        [sys.executable, *arguments],
        cwd=ROOT,
        env={**os.environ, "NUMBA_DISABLE_JIT": "1"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def test_kernels_do_the_same_uncompiled():
    tests = [f"tests/canopy_skel/{name}" for name in SMALL]
    assert "[100%]" in uncompiled("-m", "pytest", "-q", "-x", *tests)


def test_method_canopy_gives_the_same_skeleton_uncompiled():
    compiled = subprocess.run(
        [sys.executable, "-c", CANOPY], cwd=ROOT, capture_output=True, text=True, check=True
    ).stdout
    (expected, edges), (vertices, found) = map(json.loads, (compiled, uncompiled("-c", CANOPY)))
    assert len(edges) > 50
    assert found == edges
    assert np.array(vertices) == pytest.approx(np.array(expected), abs=1e-6)
