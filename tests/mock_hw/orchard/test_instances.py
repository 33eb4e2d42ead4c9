import numpy as np
import pytest
from scipy import ndimage

from mock_hw.orchard import renderer
from mock_hw.orchard.instances import (
    BEND_DEG,
    LEAST_PIXELS,
    LEAST_SKELETON_M,
    LEAST_WIDTH_PX,
    fragments_of,
    instances_of,
    pieces_of,
)
from mock_hw.orchard.kernels.components import components
from mock_hw.orchard.path import OAK_D, camera_path
from mock_hw.orchard.presets import SPECIES
from mock_hw.orchard.tree import grow

POSE = camera_path(10)[6]
TOUCHING = np.ones((3, 3))


@pytest.fixture(scope="module")
def shown(apple_scene):
    picture = renderer.draw(apple_scene.mesh, POSE, OAK_D)
    return picture, fragments_of(picture.vertex, apple_scene.tree, apple_scene.piece, POSE, OAK_D)


def test_components_are_those_of_scipy_per_label(rng):
    label = rng.integers(-1, 3, (40, 60)).astype(np.int32)
    out = np.empty_like(label)
    count = components(label, out)
    expected = 0
    for value in range(3):
        regions, n = ndimage.label(label == value, TOUCHING)
        for region in range(1, n + 1):
            assert len(np.unique(out[regions == region])) == 1
        expected += n
    assert count == expected == out.max() + 1
    assert np.array_equal(out < 0, label < 0)


@pytest.mark.parametrize("name", sorted(SPECIES))
def test_pieces_are_straight_stretches_of_one_branch(name):
    tree = grow(SPECIES[name], 2)
    piece = pieces_of(tree)
    assert np.array_equal(np.unique(piece), np.arange(piece.max() + 1))
    directions = tree.directions()
    for number in range(piece.max() + 1):
        members = np.flatnonzero(piece == number)
        assert len(np.unique(tree.branch[members])) == 1
        assert np.array_equal(members, np.arange(members[0], members[-1] + 1))
        mean = directions[members].sum(axis=0)
        cosine = directions[members] @ mean / np.linalg.norm(mean)
        typical = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
        assert np.median(typical) < BEND_DEG


def test_oaks_are_cut_more_often_than_walnuts():
    length = {}
    for name in ("oak", "walnut"):
        trees = [grow(SPECIES[name], k) for k in range(4)]
        length[name] = np.mean([len(t.position) / (pieces_of(t).max() + 1) for t in trees])
    assert length["walnut"] > 1.3 * length["oak"]


def test_an_instance_is_one_connected_region_of_one_piece(shown, apple_scene, rng):
    picture, fragments = shown
    instances, scores = instances_of(fragments, rng)
    assert instances.dtype == np.uint16
    assert instances.max() == len(scores) > 10
    for number in range(1, len(scores) + 1):
        mask = instances == number
        assert ndimage.label(mask, TOUCHING)[1] == 1
        assert len(np.unique(apple_scene.piece[picture.vertex[mask]])) == 1
        assert mask.sum() >= LEAST_PIXELS
    assert (picture.vertex[instances > 0] >= 0).all()
    assert all(0.5 <= score <= 0.99 for score in scores)


def test_only_fragments_large_enough_are_detectable(shown):
    fragments = shown[1]
    ok = fragments.detectable
    assert ok.any()
    assert not ok.all()
    assert (fragments.pixels[ok] >= LEAST_PIXELS).all()
    assert (fragments.skeleton_m[ok] >= LEAST_SKELETON_M).all()
    assert (fragments.width_px[ok] >= LEAST_WIDTH_PX).all()
    small = (
        (fragments.pixels < LEAST_PIXELS)
        | (fragments.skeleton_m < LEAST_SKELETON_M)
        | (fragments.width_px < LEAST_WIDTH_PX)
    )
    assert np.array_equal(~ok, small)


def test_fragment_width_is_the_width_of_the_wood(shown, apple_scene):
    fragments, tree = shown[1], apple_scene.tree
    long = fragments.detectable & (fragments.skeleton_m > 0.12)
    for number in np.flatnonzero(long)[:20]:
        vertex = fragments.vertex[fragments.fragment == number]
        depth = np.linalg.norm(tree.position[vertex] - POSE[:3, 3], axis=1)
        widest = 2 * tree.radius_m[vertex].mean() * OAK_D.fx_px / depth.min()
        assert fragments.width_px[number] < 1.6 * widest
