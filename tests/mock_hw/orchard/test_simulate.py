from dataclasses import replace

import numpy as np
import pytest

from canopy_skel.errors import UsageError
from canopy_skel.geometry import invert
from mock_hw.orchard import renderer
from mock_hw.orchard.camera import Camera, render_view
from mock_hw.orchard.mesh import Kind
from mock_hw.orchard.path import TOOL_FROM_CAMERA
from mock_hw.orchard.simulate import Options, prepare, truth, views
from mock_hw.orchard.wind import compliance, swayed

LEAVES = 150


@pytest.fixture(scope="module")
def options(small):
    return Options(
        leaf_count=LEAVES, rows=False, seed=7, camera=Camera(intrinsics=small, pair=True)
    )


@pytest.fixture(scope="module")
def simulation(options):
    return prepare(options)


@pytest.fixture(scope="module")
def run(simulation):
    return list(views(simulation))


def test_the_same_seeds_give_the_same_bytes(options, simulation, run):
    again = prepare(options)
    assert again.manifest() == simulation.manifest()
    for first, second in zip(run, views(again), strict=True):
        assert first.color_rgb.tobytes() == second.color_rgb.tobytes()
        assert first.depth_m.tobytes() == second.depth_m.tobytes()
        assert first.instances.tobytes() == second.instances.tobytes()
        assert first.stereo.right_mono.tobytes() == second.stereo.right_mono.tobytes()
        assert first.base_from_camera.tobytes() == second.base_from_camera.tobytes()
        assert (first.scores, first.stamp_ns) == (second.scores, second.stamp_ns)


def test_another_seed_gives_other_noise_and_light_on_the_same_tree(options, simulation, run):
    other = prepare(replace(options, seed=8))
    assert other.scene.mesh.points.tobytes() == simulation.scene.mesh.points.tobytes()
    view = next(views(other))
    assert view.depth_m.tobytes() != run[0].depth_m.tobytes()
    assert view.color_rgb.tobytes() != run[0].color_rgb.tobytes()
    assert not np.array_equal(view.base_from_camera, run[0].base_from_camera)


def test_views_come_in_order_with_everything_in_them(run, small):
    assert [view.index for view in run] == list(range(10))
    assert np.all(np.diff([view.stamp_ns for view in run]) > 0)
    for view in run:
        assert view.color_rgb.shape == (small.height_px, small.width_px, 3)
        assert view.depth_m.dtype == np.float32
        assert np.isfinite(view.depth_m).any()
        assert view.instances.max() == len(view.scores)
        assert view.stereo.baseline_m == 0.075


def test_depth_of_wood_is_near_the_truth(simulation, run, small):
    error = []
    for view, pose in zip(run, simulation.true_poses, strict=True):
        picture = renderer.draw(simulation.scene.mesh, pose, small)
        wood = (picture.kind == Kind.WOOD) & np.isfinite(view.depth_m)
        error.append((view.depth_m - picture.depth_m)[wood])
    error = np.abs(np.concatenate(error))
    expected = 1.3**2 / (small.fx_px * 0.075) * 0.25
    assert 0.3 * expected < np.median(error) < 1.5 * expected


def test_the_right_eye_sees_wood_shifted_by_its_disparity(simulation, run, small):
    differences = {1: [], -1: []}
    for view, pose in zip(run, simulation.true_poses, strict=True):
        picture = renderer.draw(simulation.scene.mesh, pose, small)
        v, u = np.nonzero(picture.kind == Kind.WOOD)
        disparity = small.fx_px * view.stereo.baseline_m / picture.depth_m[v, u]
        for sign, found in differences.items():
            column = np.rint(u - sign * disparity).astype(int)
            inside = (column >= 0) & (column < small.width_px)
            left = view.stereo.left_mono[v, u].astype(int)[inside]
            found.append(np.abs(left - view.stereo.right_mono[v[inside], column[inside]]))
    right, wrong = (np.concatenate(differences[sign]).mean() for sign in (1, -1))
    assert right < 20
    assert right < 0.6 * wrong


def test_reported_poses_carry_one_hand_eye_error_and_a_small_one_per_view(simulation):
    hand_eye = invert(TOOL_FROM_CAMERA) @ simulation.tool_from_camera
    assert 0 < np.linalg.norm(hand_eye[:3, 3]) < 0.005
    for reported, true in zip(simulation.reported_poses, simulation.true_poses, strict=True):
        tool = reported @ invert(simulation.tool_from_camera)
        drift = np.linalg.norm((tool - true @ invert(TOOL_FROM_CAMERA))[:3, 3])
        assert 0 < drift < 0.0015
    both = zip(simulation.reported_poses, simulation.true_poses, strict=True)
    error = np.mean([(invert(true) @ reported)[:3, 3] for reported, true in both], axis=0)
    assert error == pytest.approx(hand_eye[:3, 3], abs=0.0003)
    assert np.linalg.norm(hand_eye[:3, 3]) > 0.0007


def test_without_noise_the_reported_poses_are_the_true_ones(options):
    exact = prepare(replace(options, noise="none"))
    for reported, true in zip(exact.reported_poses, exact.true_poses, strict=True):
        assert reported == pytest.approx(true, abs=1e-12)


def test_truth_is_a_document_of_the_whole_tree(simulation):
    document, tree = truth(simulation), simulation.scene.tree
    assert document.position.tobytes() == tree.position.tobytes()
    assert len(document.edges) == len(tree.position) - 1
    pairs = [
        pair
        for branch in document.branches
        for pair in zip(branch.vertices, branch.vertices[1:], strict=False)
    ]
    assert sorted(pairs) == sorted(map(tuple, document.edges.tolist()))
    for branch in document.branches:
        if branch.parent is not None:
            assert branch.vertices[0] in document.branches[branch.parent].vertices
        assert branch.length == pytest.approx(0.008 * (len(branch.vertices) - 1))
    assert document.branches[0].kind == "trunk"


def test_truth_says_what_no_view_shows(simulation, small):
    document = truth(simulation)
    most = np.zeros(len(document.position), dtype=int)
    for pose in simulation.true_poses:
        vertex = renderer.draw(simulation.scene.mesh, pose, small).vertex
        most = np.maximum(most, np.bincount(vertex[vertex >= 0], minlength=len(most)))
    assert np.array_equal(document.occluded, most < 2)
    segmented, framed = (np.array(document.extra[key]) for key in ("segmented", "framed"))
    assert 0 < segmented.mean() < 1
    assert not (segmented & ~framed).any()


def test_segmented_truth_is_what_the_instances_of_the_views_cover(simulation, run, small):
    covered = np.zeros(len(simulation.scene.tree.position), dtype=bool)
    for view, pose in zip(run, simulation.true_poses, strict=True):
        vertex = renderer.draw(simulation.scene.mesh, pose, small).vertex
        covered[vertex[view.instances > 0]] = True
    assert np.array_equal(covered, np.array(truth(simulation).extra["segmented"]))


def test_any_pose_can_be_rendered(simulation, small):
    pose = simulation.true_poses[3].copy()
    pose[:3, 3] += [0.05, -0.02, 0.03]
    camera = Camera(intrinsics=small, noise=None)
    view = render_view(simulation.scene, pose, camera, index=42, stamp_ns=5, seed=1)
    picture = renderer.draw(simulation.scene.mesh, pose, small)
    assert view.index == 42
    assert np.array_equal(view.base_from_camera, pose)
    assert np.array_equal(np.isnan(view.depth_m), np.isinf(picture.depth_m))
    assert view.stereo is None


def test_wind_moves_tips_and_neither_the_foot_nor_the_labels(simulation, rng):
    scene = simulation.scene
    give = compliance(scene.tree)
    assert give[0] == 0
    assert (give[scene.tree.edges()[:, 1]] > give[scene.tree.edges()[:, 0]]).all()
    moved = swayed(scene.mesh, scene.tree, 0.02, rng)
    shift = np.linalg.norm(moved.points - scene.mesh.points, axis=1)
    wood = np.unique(scene.mesh.triangles[scene.mesh.kind == Kind.WOOD])
    assert 0.003 < shift[wood].max() < 0.12
    assert shift[wood[scene.mesh.anchor[wood] < 20]].max() < 1e-3
    assert shift[scene.mesh.anchor < 0].max() == 0
    assert moved.vertex is scene.mesh.vertex


@pytest.mark.parametrize("kind", [Kind.WOOD, Kind.LEAF])
def test_wind_tears_nothing(simulation, rng, kind):
    mesh = simulation.scene.mesh
    moved = swayed(mesh, simulation.scene.tree, 0.02, rng)
    edges = mesh.triangles[mesh.kind == kind][:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    before, after = (np.diff(m.points[edges], axis=1)[:, 0] for m in (mesh, moved))
    assert np.linalg.norm(after - before, axis=1).max() < 0.003


def test_a_windy_scan_is_repeatable_and_differs_from_view_to_view(options):
    windy = replace(options, wind_m=0.02, camera=replace(options.camera, pair=False))
    first, second = (list(views(prepare(windy)))[:2] for _ in range(2))
    assert first[1].depth_m.tobytes() == second[1].depth_m.tobytes()
    still = next(views(prepare(options)))
    assert first[0].instances.tobytes() != still.instances.tobytes()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"species": "pear"}, "unknown species"),
        ({"weather": "hail"}, "unknown weather 'hail'; choose fair or any"),
        ({"noise": "awful"}, "unknown noise"),
        ({"topology": -1}, "topology is -1; give 0 or more"),
        ({"wind_m": -0.1}, "wind_m is -0.1; give 0 or more"),
        ({"views": 3}, "no camera path with 3 views"),
    ],
)
def test_options_outside_their_range_are_refused(options, change, message):
    with pytest.raises(UsageError, match=message):
        prepare(replace(options, **change))
