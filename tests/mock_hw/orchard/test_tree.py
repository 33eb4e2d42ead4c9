from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from canopy_skel.errors import UsageError
from mock_hw.orchard.presets import APPLE, SPECIES, species_named
from mock_hw.orchard.tree import GROUND_Z_M, HEDGE_M, SPACING_M, TOP_Z_M, TRUNK_X_M, grow

any_tree = given(st.sampled_from(sorted(SPECIES)), st.integers(0, 2**31))


@any_tree
@settings(max_examples=15, deadline=None)
def test_every_tree_is_one_rooted_tree_of_evenly_spaced_vertices(name, seed):
    tree = grow(SPECIES[name], seed)
    size = len(tree.position)
    assert tree.parent[0] == -1
    assert (tree.parent[1:] >= 0).all()
    assert (tree.parent[1:] < np.arange(1, size)).all()
    edges = tree.edges()
    steps = np.linalg.norm(np.diff(tree.position[edges], axis=1)[:, 0], axis=1)
    assert np.allclose(steps, SPACING_M)
    assert tree.position[0] == pytest.approx([TRUNK_X_M, 0, GROUND_Z_M])
    assert tree.position[1:, 2].min() > GROUND_Z_M
    assert np.abs(tree.position[:, 0] - TRUNK_X_M).max() <= HEDGE_M
    assert 1.35 < tree.position[:, 2].max() - GROUND_Z_M <= TOP_Z_M - GROUND_Z_M


@any_tree
@settings(max_examples=15, deadline=None)
def test_branches_partition_the_vertices_and_start_on_their_parent(name, seed):
    tree = grow(SPECIES[name], seed)
    own = [tree.branches[0].vertices, *(branch.vertices[1:] for branch in tree.branches[1:])]
    assert np.array_equal(np.concatenate(own), np.arange(len(tree.position)))
    for branch in tree.branches[1:]:
        parent = tree.branches[branch.parent]
        assert branch.vertices[0] in parent.vertices
        assert tree.branch[branch.vertices[0]] == branch.parent
        assert branch.order == parent.order + 1
        assert np.array_equal(tree.parent[branch.vertices[1:]], branch.vertices[:-1])


@any_tree
@settings(max_examples=15, deadline=None)
def test_wood_gets_thinner_along_branches_and_never_thicker_at_forks(name, seed):
    tree = grow(SPECIES[name], seed)
    child = np.flatnonzero(tree.parent >= 0)
    growth = tree.radius_m[child] - tree.radius_m[tree.parent[child]]
    assert growth.max() <= 1e-12
    assert tree.radius_m.min() >= SPECIES[name].tip_radius_m - 1e-12


def test_the_same_seed_gives_the_same_tree_and_another_seed_another():
    one, same, other = grow(APPLE, 5), grow(APPLE, 5), grow(APPLE, 6)
    assert one.position.tobytes() == same.position.tobytes()
    assert one.radius_m.tobytes() == same.radius_m.tobytes()
    assert one.position.shape != other.position.shape or (one.position != other.position).any()


def test_each_branch_has_its_own_stream_so_twigs_do_not_move_limbs():
    twiggy = replace(APPLE.orders[3], per_metre=6.0, length_m=(0.2, 0.2, 0.2))
    changed = grow(replace(APPLE, orders=(*APPLE.orders[:3], twiggy)), 5)
    tree = grow(APPLE, 5)
    keep, changed_keep = tree.order < 3, changed.order < 3
    assert len(changed.position) > len(tree.position)
    assert tree.position[keep].tobytes() == changed.position[changed_keep].tobytes()


def test_species_have_their_habit():
    apples, oaks = ([grow(SPECIES[name], k) for k in range(6)] for name in ("apple", "oak"))
    leader = [tree.position[tree.branches[0].vertices[-1], 2] for tree in apples]
    assert min(leader) > TOP_Z_M - 0.1, "an apple keeps its leader up to the top"
    for tree in oaks:
        trunk_top = tree.position[tree.branches[0].vertices[-1], 2]
        assert trunk_top < GROUND_Z_M + 1.1, "an oak's trunk goes over into limbs"
    spread = {
        name: np.mean([np.abs(grow(SPECIES[name], k).position[:, 1]).max() for k in range(6)])
        for name in SPECIES
    }
    assert spread["oak"] > 0.6
    low = np.concatenate([t.position[(t.position[:, 2] < 0) & (t.order == 1), 1] for t in apples])
    high = np.concatenate(
        [t.position[(t.position[:, 2] > 0.5) & (t.order == 1), 1] for t in apples]
    )
    assert np.abs(low).max() > 1.3 * np.abs(high).max(), "an apple spindle is wide below"


def test_unknown_species_are_refused_by_name():
    with pytest.raises(UsageError, match="unknown species 'pear'; choose one of apple, oak"):
        species_named("pear")
