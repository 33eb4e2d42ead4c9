import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from oracles import naive_likelihood

from canopy_skel.errors import UsageError
from canopy_skel.likelihood import BYTES_PER_SLOT, LikelihoodConfig, LikelihoodMap, Segments

VOXEL = 0.01


def coordinate(step, offset):
    """Off the borders and edges of voxels, where either side is right."""
    return st.integers(-40, 40).map(lambda n: n * step + offset)


point = st.tuples(
    coordinate(1e-3, 3.7e-4), coordinate(1.013e-3, 5.3e-4), coordinate(0.977e-3, 7.1e-4)
)
segment = st.tuples(point, point, st.sampled_from([0.002, 0.005, 0.01]), st.floats(0.05, 1.0))


def segments_from(rows):
    return Segments(
        starts_in_base=np.array([r[0] for r in rows]).reshape(-1, 3),
        ends_in_base=np.array([r[1] for r in rows]).reshape(-1, 3),
        radius_m=np.array([r[2] for r in rows]),
        confidence=np.array([r[3] for r in rows]),
    )


def long_enough(row):
    return np.linalg.norm(np.subtract(row[1], row[0])) > 0.004


def grid_of(*groups, voxel=VOXEL):
    likelihood = LikelihoodMap(LikelihoodConfig(voxel_size_m=voxel))
    for rows in groups:
        likelihood.add(segments_from(rows))
    return likelihood.grid()


@given(st.lists(segment.filter(long_enough), min_size=1, max_size=2))
@settings(max_examples=25)
def test_map_is_the_papers_formula(rows):
    grid = grid_of(rows)
    low, high = (-6, -6, -6), (6, 6, 6)
    inside = ((grid.voxels >= low) & (grid.voxels < high)).all(axis=1)
    dense = np.zeros((12, 12, 12))
    dense[tuple((grid.voxels - low)[inside].T)] = grid.probability()[inside]
    expected = naive_likelihood.likelihood(segments_from(rows), VOXEL, 3.0, 0.999, low, high)
    np.testing.assert_allclose(dense, expected, atol=2e-5 * len(rows))


direction = st.one_of(
    st.sampled_from([(1.0, 0, 0), (0, -1.0, 0), (0, 0, 1.0), (1e-13, 0, 1.0), (1e-9, 1e-9, -1.0)]),
    st.tuples(*[st.floats(-1, 1)] * 3).filter(lambda d: np.linalg.norm(d) > 0.1),
)


@given(point, direction, st.floats(0.3, 6), st.floats(1e-3, 3), st.floats(0.01, 1.0))
def test_every_voxel_gets_the_formula_to_a_unit(start, way, length, radius, confidence):
    """Single precision is enough, and no voxel of the support is left out."""
    start, axis = np.array(start), np.array(way) / np.linalg.norm(way)
    grid = grid_of([(start, start + axis * length * VOXEL, radius * VOXEL, confidence)])
    low, high = grid.voxels.min(axis=0) - 1, grid.voxels.max(axis=0) + 2
    voxels = np.stack(np.meshgrid(*map(np.arange, low, high), indexing="ij"), axis=-1)
    offset = voxels + 0.5 - start / VOXEL
    along = offset @ axis
    beyond = np.maximum(0, np.maximum(-along, along - length)) / length
    across = np.linalg.norm(offset - along[..., None] * axis, axis=-1) / radius
    c = min(confidence, 0.999)
    p = np.maximum(0, c - c / 3 * np.hypot(beyond, across))
    units = np.zeros(p.shape)
    units[tuple((grid.voxels - low).T)] = grid.units
    off = np.abs(units + np.log1p(-p) * 65536)
    full = np.abs(units + np.log1p(-c) * 65536) <= 1  # or the segment passes here (rule 1)
    assert (off[~full] <= 1).all()
    assert full.sum() - (off <= 1)[full].sum() <= 2 + 2 * length


def test_support_ends_where_the_formula_does():
    grid = grid_of([((0.0, 0.0, 0.0), (0.05, 0.0, 0.0), 0.01, 0.6)])
    centres = grid.centres_in_base()
    assert centres[:, 0].min() > 0.0 - 3 * 0.05
    assert centres[:, 0].max() < 0.05 + 3 * 0.05
    assert np.hypot(centres[:, 1], centres[:, 2]).max() < 3 * 0.01 + 1e-9


def test_a_thin_branch_fills_every_voxel_it_passes():
    rows = [((0.001, 0.001, 0.001), (0.2, 0.13, 0.077), 0.0002, 0.7)]
    grid = grid_of(rows)
    place = {tuple(v): i for i, v in enumerate(grid.voxels.tolist())}
    along = np.linspace(0, 1, 5000)[:, None]
    passed = np.floor((rows[0][0] + along * np.subtract(rows[0][1], rows[0][0])) / VOXEL)
    for voxel in np.unique(passed.astype(int), axis=0).tolist():
        assert grid.probability()[place[tuple(voxel)]] == pytest.approx(0.7, abs=1e-4)


@given(
    st.lists(st.lists(segment.filter(long_enough), min_size=1, max_size=3), min_size=2, max_size=4),
    st.randoms(),
)
def test_the_order_of_views_does_not_matter_to_the_bit(groups, random):
    shuffled = list(groups)
    random.shuffle(shuffled)
    one, other = grid_of(*groups), grid_of(*shuffled)
    assert one.voxels.tobytes() == other.voxels.tobytes()
    assert one.units.tobytes() == other.units.tobytes()


@given(st.lists(segment.filter(long_enough), min_size=2, max_size=4))
def test_more_evidence_never_lowers_the_likelihood(rows):
    before, after = grid_of(rows[:-1]), grid_of(rows)
    place = {tuple(v): i for i, v in enumerate(after.voxels.tolist())}
    for voxel, units in zip(before.voxels.tolist(), before.units, strict=True):
        assert after.units[place[tuple(voxel)]] >= units


@given(st.lists(segment.filter(long_enough), min_size=1, max_size=4))
def test_scaling_scene_and_voxel_together_changes_nothing(rows):
    doubled = [(tuple(2 * np.array(s)), tuple(2 * np.array(e)), 2 * r, c) for s, e, r, c in rows]
    one, other = grid_of(rows), grid_of(doubled, voxel=2 * VOXEL)
    np.testing.assert_array_equal(one.voxels, other.voxels)
    np.testing.assert_array_equal(one.units, other.units)


def test_certain_masks_stay_finite():
    rows = [((0.0, 0.0, 0.0), (0.05, 0.0, 0.0), 0.01, 1.0)] * 5000
    grid = grid_of(rows)
    assert np.isfinite(grid.empty_probability()).all()
    assert grid.units.min() > 0


@pytest.mark.parametrize("voxel", [0.0, -0.005, 0.5, float("nan"), float("inf")])
def test_a_voxel_size_must_be_a_length(voxel):
    with pytest.raises(UsageError, match="voxel size"):
        LikelihoodConfig(voxel_size_m=voxel)


def test_a_map_that_does_not_fit_names_a_voxel_size_that_does():
    rows = [((0.0, 0.0, 0.0), (0.5, 0.0, 0.0), 0.02, 0.9)]
    small = LikelihoodMap(LikelihoodConfig(voxel_size_m=0.0005), memory_limit_bytes=1 << 24)
    with pytest.raises(UsageError, match=r"([0-9.]+) m fits") as raised:
        small.add(segments_from(rows))
    fits = float(str(raised.value).rsplit(" m fits", 1)[0].split()[-1])
    again = LikelihoodMap(LikelihoodConfig(voxel_size_m=fits), memory_limit_bytes=1 << 24)
    again.add(segments_from(rows))
    assert len(again.grid().voxels) > 0


@pytest.mark.parametrize("radius_m", [0.02, 0.05, 0.12])
def test_the_memory_asked_for_is_about_what_is_used_however_thick_the_wood(radius_m):
    rows = [((0.0, 0.3 * k, 0.0), (0.1, 0.3 * k, 0.1), radius_m, 0.9) for k in range(4)]
    settings_ = LikelihoodConfig(voxel_size_m=VOXEL)
    free = LikelihoodMap(settings_, memory_limit_bytes=1 << 31)
    free.add(segments_from(rows))
    used = free.blocks.slots * BYTES_PER_SLOT
    LikelihoodMap(settings_, memory_limit_bytes=3 * used).add(segments_from(rows))
    with pytest.raises(UsageError, match="m fits"):
        LikelihoodMap(settings_, memory_limit_bytes=used // 2).add(segments_from(rows))


def test_an_empty_map_has_no_voxels():
    grid = LikelihoodMap(LikelihoodConfig()).grid()
    assert grid.voxels.shape == (0, 3)
    assert grid.probability().shape == (0,)
