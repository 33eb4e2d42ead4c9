import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scenes.bars import KNOWN, MAP, MIDDLE, RADIUS_CELLS, SIZE, bar, candidates

from canopy_skel.segmenters.unet.network import Known, Maps
from canopy_skel.segmenters.unet.precision import has_fast_bfloat16
from canopy_skel.segmenters.unet.scorer import (
    ACROSS,
    ALONG,
    BESIDE,
    Scorer,
    mirrored,
    strips_of,
)


@given(angle=st.floats(0, 180), length=st.floats(40, 70))
def test_a_strip_shows_a_strand_along_its_axis_whichever_way_it_runs(angle, length):
    known, cells = bar(angle, length)
    (strip,) = strips_of(known, candidates(cells))
    assert strip.shape == (KNOWN + BESIDE, ALONG, ACROSS)
    reach = np.linspace(-1.5, 1.5, ALONG)
    sure, middle = abs(reach) < 0.9, ACROSS // 2
    own, inside = strip[-2], strip[-1]
    assert own[sure, middle].all()
    assert not own[abs(reach) > 1.1].any()
    assert not own[:, [0, -1]].any()  # three radii aside
    assert inside.all()
    assert strip[MAP["branch"]][sure, middle] == pytest.approx(4, abs=1e-4)
    assert strip[MAP["branch"]].min() == -8
    assert strip[MAP["cosine"]] == pytest.approx(1, abs=0.02)
    assert strip[MAP["sine"]] == pytest.approx(0, abs=0.1)
    assert strip[MAP["log_radius"]] == pytest.approx(0, abs=0.01)
    assert strip[MAP["log_length"]] == pytest.approx(0, abs=0.1)
    # An axis has no head: what lies ahead may lie behind as well.
    ways = strip[MAP["middle_u"]][sure, middle]
    sign = np.sign(ways[0] * -reach[sure][0])
    assert sign * ways == pytest.approx(-reach[sure], abs=0.12)
    assert strip[MAP["middle_v"]] == pytest.approx(0, abs=0.1)
    assert strip[len(Maps._fields) : KNOWN] == pytest.approx(7, abs=1e-4)


def test_a_strip_is_looked_up_between_cells():
    known, cells = bar(33, 61)
    known.features[1], known.features[0] = np.mgrid[: SIZE[0], : SIZE[1]]
    (strip,) = strips_of(known, candidates(cells))
    u, v = strip[len(Maps._fields) : KNOWN]
    c, s = np.cos(np.radians(33)), np.sin(np.radians(33))
    along, across = (
        (u - MIDDLE[0]) * c + (v - MIDDLE[1]) * s,
        (v - MIDDLE[1]) * c - (u - MIDDLE[0]) * s,
    )
    reach = np.linspace(-1.5, 1.5, ALONG)[:, None] * 61 / 2
    assert along == pytest.approx(np.broadcast_to(reach, along.shape), abs=1.5)
    assert np.diff(along, axis=0) == pytest.approx(np.ptp(along[:, 4]) / (ALONG - 1), abs=0.03)
    aside = np.linspace(-1, 1, ACROSS) * 3 * RADIUS_CELLS
    assert across == pytest.approx(np.broadcast_to(aside, across.shape), abs=0.5)
    assert np.diff(across, axis=1) == pytest.approx(3 * RADIUS_CELLS / 4, abs=0.03)


def test_what_lies_outside_the_picture_is_empty_and_said_to_be():
    known, _ = bar(0, 40)
    v, u = np.mgrid[50:58, 0:40]
    (strip,) = strips_of(known, candidates(np.ravel_multi_index((v.ravel(), u.ravel()), SIZE)))
    outside = strip[-1] == 0
    assert outside[:5].all()
    assert not outside[8:].any()
    assert (strip[-3][:4] == 0).all()
    assert strip[-3][8:] == pytest.approx(7, abs=1e-4)


def test_strips_of_one_strand_do_not_depend_on_the_others():
    known, cells = bar(30, 60)
    other = np.arange(40)
    (alone,) = strips_of(known, candidates(cells))
    _, together = strips_of(known, candidates(other, cells))
    assert np.array_equal(alone, together)


def random_scorer():
    """A scorer that is not taught but speaks its mind."""
    torch.manual_seed(1)
    scorer = Scorer(KNOWN).eval()
    scorer.seen.fill_(1.0)
    return scorer


def test_scores_are_between_none_and_one_each_for_itself():
    scorer = random_scorer()
    known, cells = bar(30, 60)
    pair = scorer.scores(known, candidates(np.arange(40), cells))
    assert pair.shape == (2,)
    assert ((pair > 0) & (pair < 1)).all()
    assert scorer.scores(known, candidates(cells))[0] == pytest.approx(pair[1], abs=1e-6)
    assert scorer.scores(known, candidates()).shape == (0,)


def test_more_strands_than_fit_into_one_batch_are_all_scored():
    scorer = random_scorer()
    known, cells = bar(0, 60)
    across = np.arange(SIZE[0] * SIZE[1]).reshape(SIZE)[30:90, 78:82].ravel()
    kinds = [cells, cells[: len(cells) // 2], np.arange(40), across, across[:120]]
    scores = scorer.scores(known, candidates(*(kinds[k % 5] for k in range(600))))
    assert scores == pytest.approx(np.tile(scores[:5], 120), abs=1e-6)
    assert np.diff(np.sort(scores[:5])).min() > 1e-5


def test_one_that_never_saw_a_strand_says_one_half():
    known, cells = bar(0, 60)
    assert Scorer(KNOWN).eval().scores(known, candidates(cells)) == 0.5


@pytest.mark.skipif(not has_fast_bfloat16(), reason="this CPU has no bfloat16 arithmetic")
def test_bfloat16_scores_nearly_the_same():
    known, cells = bar(30, 60)
    scorer, both = random_scorer(), candidates(np.arange(40), cells)
    assert scorer.scores(known, both, bfloat16=True) == pytest.approx(
        scorer.scores(known, both), abs=0.01
    )


def test_a_score_is_the_same_from_either_end():
    scorer = random_scorer()
    strips = torch.randn(5, KNOWN + BESIDE, ALONG, ACROSS)
    with torch.inference_mode():
        turned = scorer(mirrored(strips, along=True, across=True))
        assert torch.allclose(turned, scorer(strips), atol=1e-5)


def upside_down(known):
    maps = known.maps[:, ::-1].copy()
    maps[[MAP["sine"], MAP["middle_v"]]] *= -1
    return Known(maps, known.features[:, ::-1])


def turned_round(known):
    maps = known.maps[:, ::-1, ::-1].copy()
    maps[[MAP["middle_u"], MAP["middle_v"]]] *= -1
    return Known(maps, known.features[:, ::-1, ::-1])


@pytest.mark.parametrize(
    ("changed", "flip", "along"),
    [(upside_down, np.s_[::-1], False), (turned_round, np.s_[::-1, ::-1], True)],
)
def test_a_mirrored_strip_is_the_strip_of_a_mirrored_picture(changed, flip, along):
    known, cells = bar(20, 60)
    known.maps[MAP["branch"], 30:50, 90:110] = 3.0
    known.features[0, 60:, :70] = 1.0
    place = np.zeros(SIZE, bool)
    place.ravel()[cells] = True
    (strip,) = strips_of(known, candidates(cells))
    (other,) = strips_of(changed(known), candidates(np.flatnonzero(place[flip])))
    wanted = mirrored(torch.from_numpy(strip[None]), along=along, across=True)[0].numpy()
    assert other[:-2] == pytest.approx(wanted[:-2], abs=1e-3)
