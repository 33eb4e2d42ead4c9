"""What the scores must say of outputs whose worth is known beforehand."""

import json
import warnings
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader

from canopy_skel.document import Branch, Method, SkeletonDocument
from canopy_skel.errors import DocumentError, UsageError
from canopy_skel.geometry import rotation_from_quaternion
from canopy_skel.metrics import Scores, score

RECORDINGS = Path(__file__).parents[2] / "../shared/data/recordings"
SEEDS = st.integers(0, 2**32 - 1)
few = settings(max_examples=25, deadline=None)


def document(position, edges, *, branches=(), **arrays) -> SkeletonDocument:
    position = np.asarray(position, dtype=float).reshape(-1, 3)
    n = len(position)
    return SkeletonDocument(
        scan_id="test",
        revision=0,
        method=Method(name="test"),
        views_used=0,
        views_rejected=(),
        position=position,
        radius=arrays.get("radius", np.full(n, 0.005)),
        occluded=arrays.get("occluded", np.zeros(n, dtype=bool)),
        confidence=arrays.get("confidence", np.ones(n)),
        edges=np.asarray(edges, dtype=np.int64).reshape(-1, 2),
        branches=tuple(
            Branch(
                id=i,
                parent=None,
                order=0,
                kind="branch",
                vertices=tuple(vertices),
                length=0.0,
                mean_radius=0.005,
                confidence=1.0,
            )
            for i, vertices in enumerate(branches)
        ),
        root=0,
        components=1,
        extra={name: tuple(arrays[name]) for name in ("segmented", "framed") if name in arrays},
    )


def line(start, end, count=41, **arrays) -> SkeletonDocument:
    position = np.linspace(start, end, count)
    chain = list(range(count))
    return document(position, list(pairwise(chain)), branches=[chain], **arrays)


def random_tree(seed: int, size: int = 120) -> SkeletonDocument:
    """Grow a tree with a step of 4 to 12 mm, four forks, and random flags in runs."""
    rng = np.random.default_rng(seed)
    position, edges, branches = [np.zeros(3)], [], []
    for _ in range(5):
        at = int(rng.integers(len(position)))
        heading, chain = rng.normal(size=3), [at]
        for _ in range(size // 5):
            heading = heading / np.linalg.norm(heading) + 0.15 * rng.normal(size=3)
            step = rng.uniform(0.004, 0.012) * heading / np.linalg.norm(heading)
            edges.append((chain[-1], len(position)))
            chain.append(len(position))
            position.append(position[edges[-1][0]] + step)
        branches.append(chain)
    runs = np.repeat(rng.random((len(position) // 8 + 1, 2)), 8, axis=0)[: len(position)]
    return document(
        position,
        edges,
        branches=branches,
        radius=rng.uniform(0.002, 0.03, len(position)),
        segmented=(runs[:, 0] < 0.5).tolist(),
        occluded=(runs[:, 0] >= 0.5) & (runs[:, 1] < 0.5),
    )


def disturbed(tree: SkeletonDocument, seed: int) -> SkeletonDocument:
    """Return what a method might make of a tree: displaced, incomplete, unsure."""
    rng = np.random.default_rng(seed)
    n = len(tree.position)
    return replace(
        tree,
        position=tree.position + rng.normal(scale=0.008, size=(n, 3)),
        radius=tree.radius * rng.uniform(0.7, 1.4, n),
        confidence=rng.random(n),
        occluded=rng.random(n) < 0.3,
        edges=tree.edges[rng.random(len(tree.edges)) < 0.9],
        extra={},
    )


def assert_same(a: Scores, b: Scores, tolerance: float) -> None:
    for name, value in a.to_dict().items():
        assert b.to_dict()[name] == pytest.approx(value, abs=tolerance), name


@few
@given(SEEDS)
def test_truth_against_itself_is_perfect(seed):
    truth = random_tree(seed)
    scores = score(truth, truth)
    perfect = {
        name: value
        for name, value in scores.to_dict().items()
        if name.startswith(("precision", "recall", "parent")) or name in ("length_ratio", "auc")
    }
    splits = {"recall_masked", "recall_unmasked", "recall_visible_unmasked", "recall_hidden"}
    assert {name for name, value in perfect.items() if value is None} <= splits
    for name, value in perfect.items():
        assert value is None or value == pytest.approx(1.0, abs=1e-9), name
    assert scores.joined == (1.0 if scores.gaps else None)
    assert scores.radius_error_mean in (None, pytest.approx(0.0, abs=1e-6))
    assert (scores.components, scores.acyclic) == (1, True)
    assert scores.output_length_m == pytest.approx(
        np.linalg.norm(np.diff(truth.position[truth.edges], axis=1), axis=2).sum()
    )


@few
@given(SEEDS)
def test_moving_both_changes_nothing(seed):
    truth = random_tree(seed)
    output = disturbed(truth, seed)
    rng = np.random.default_rng(seed)
    rotation, shift = rotation_from_quaternion(rng.normal(size=4)), rng.normal(size=3)
    moved = [replace(d, position=d.position @ rotation.T + shift) for d in (output, truth)]
    assert_same(score(output, truth), score(*moved), 1e-9)


def permuted(tree: SkeletonDocument, rng: np.random.Generator) -> SkeletonDocument:
    old_of_new = rng.permutation(len(tree.position))
    new_of_old = np.argsort(old_of_new)
    edges = rng.permutation(new_of_old[tree.edges])
    flip = rng.random(len(edges)) < 0.5
    return replace(
        tree,
        position=tree.position[old_of_new],
        radius=tree.radius[old_of_new],
        occluded=tree.occluded[old_of_new],
        confidence=tree.confidence[old_of_new],
        edges=np.where(flip[:, None], edges[:, ::-1], edges),
        branches=tuple(
            replace(b, vertices=tuple(new_of_old[list(b.vertices)].tolist())) for b in tree.branches
        ),
        extra={name: tuple(np.array(v)[old_of_new].tolist()) for name, v in tree.extra.items()},
    )


@few
@given(SEEDS)
def test_the_order_of_vertices_and_edges_is_of_no_account(seed):
    truth = random_tree(seed)
    output = disturbed(truth, seed)
    rng = np.random.default_rng(seed)
    assert_same(score(output, truth), score(permuted(output, rng), permuted(truth, rng)), 1e-9)


@few
@given(SEEDS)
def test_junk_far_away_lowers_precision_only(seed):
    truth = random_tree(seed)
    output = disturbed(truth, seed)
    n = len(output.position)
    with_junk = replace(
        output,
        position=np.vstack([output.position, [[9, 9, 9], [9, 9, 9.3]]]),
        radius=np.append(output.radius, [0.1, 0.1]),
        occluded=np.append(output.occluded, [False, False]),
        confidence=np.append(output.confidence, [1.0, 1.0]),
        edges=np.vstack([output.edges, [[n, n + 1]]]),
    )
    clean, junk = score(output, truth).to_dict(), score(with_junk, truth).to_dict()
    for name in clean:
        if name.startswith("precision"):
            assert junk[name] < clean[name], name
        if name.startswith(("recall", "joined", "gaps", "radius", "parent", "occ_")):
            assert junk[name] == pytest.approx(clean[name], abs=1e-12), name


@few
@given(SEEDS)
def test_removing_edges_never_raises_recall(seed):
    truth = random_tree(seed)
    output = disturbed(truth, seed)
    keep = np.random.default_rng(seed).random(len(output.edges)) < 0.7
    more = score(output, truth).to_dict()
    less = score(replace(output, edges=output.edges[keep]), truth).to_dict()
    for name in more:
        if name.startswith(("recall", "joined")) and more[name] is not None:
            assert less[name] <= more[name] + 1e-9, name


@few
@given(SEEDS, st.sampled_from([3, 5]))
def test_where_the_vertices_lie_on_the_curve_is_of_no_account(seed, parts):
    truth = random_tree(seed)
    output = disturbed(truth, seed)
    a, b = score(output, truth), score(subdivided(output, parts), truth)
    rests_on_vertices = {"joined", "components", "parent_correct"}
    for name, value in a.to_dict().items():
        if not name.endswith("_vertices") and name not in rests_on_vertices:
            assert b.to_dict()[name] == pytest.approx(value, abs=1e-9), name


def subdivided(tree: SkeletonDocument, parts: int) -> SkeletonDocument:
    position, edges = list(tree.position), []
    values = {name: list(getattr(tree, name)) for name in ("radius", "confidence", "occluded")}
    for a, b in tree.edges.tolist():
        previous = a
        for k in range(1, parts):
            f = k / parts
            position.append((1 - f) * tree.position[a] + f * tree.position[b])
            for name in ("radius", "confidence"):
                old = getattr(tree, name)
                values[name].append((1 - f) * old[a] + f * old[b])
            values["occluded"].append(tree.occluded[b if f > 0.5 else a])
            edges.append((previous, len(position) - 1))
            previous = len(position) - 1
        edges.append((previous, b))
    return replace(
        tree,
        position=np.array(position),
        edges=np.array(edges),
        branches=(),
        **{name: np.array(value) for name, value in values.items()},
    )


def test_a_doubled_line_has_twice_the_length_of_what_it_covers():
    truth = line((0, 0, 0), (0, 0, 0.8))
    doubled = document(
        np.vstack([truth.position, truth.position + np.array([0.005, 0, 0])]),
        np.vstack([truth.edges, truth.edges + 41]),
    )
    scores = score(doubled, truth)
    assert scores.length_ratio == pytest.approx(2.0)
    assert (scores.precision, scores.recall, scores.components) == (1.0, 1.0, 2)


def test_an_empty_output_claims_nothing_and_finds_nothing():
    truth = random_tree(1)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        scores = score(document([], []), truth)
    assert scores.precision is scores.precision_length is scores.precision_strict is None
    assert scores.recall == scores.recall_length == scores.recall_masked == scores.auc == 0
    assert (scores.joined, scores.length_ratio, scores.ece) == (0.0, None, None)
    assert (scores.components, scores.acyclic) == (0, True)


@pytest.mark.parametrize("single_is", ["output", "truth", "both"])
def test_a_single_vertex_counts_only_as_a_vertex(single_is):
    single, tree = document([[0, 0, 0.01]], []), line((0, 0, 0), (0, 0, 0.4))
    output = single if single_is in ("output", "both") else tree
    truth = single if single_is in ("truth", "both") else tree
    scores = score(output, truth)
    assert (scores.precision is None) == (output is single)
    assert (scores.recall is None) == (truth is single)
    assert scores.precision_vertices > 0
    assert scores.recall_vertices > 0
    json.dumps(scores.to_dict(), allow_nan=False)


def test_the_paper_counts_pieces_and_length_weighs_them():
    truth = line((0, 0, 0), (0, 0, 0.8), 33)
    output = document(
        [[0, 0, 0], [0, 0, 0.4], [1, 0, 0], [1, 0, 0.1]],
        [[0, 1], [2, 3]],
        occluded=np.array([False, True, True, True]),
    )
    scores = score(output, truth)
    assert scores.precision == pytest.approx(50 / (50 + 13))
    assert scores.precision_length == pytest.approx(0.4 / 0.5)
    assert scores.osr == pytest.approx(25 / 63)
    assert scores.occ_precision == pytest.approx(0.2 / 0.3)
    assert scores.recall == pytest.approx(0.42 / 0.8, abs=0.011)
    assert scores.recall_length == pytest.approx(0.42 / 0.8, abs=0.011)
    assert (scores.precision_vertices, scores.osr_vertices) == (0.5, 0.25)
    assert scores.recall_vertices == pytest.approx(2 / 33)


def test_a_distance_of_just_the_tolerance_still_corresponds():
    truth, output = line((0, 0, 0), (0, 0, 0.5), 2), line((0.25, 0, 0), (0.25, 0, 0.5), 2)
    scores = score(output, truth, tolerance_m=0.25)
    assert scores.precision == scores.recall == scores.precision_vertices == 1.0
    assert scores.precision_strict == scores.precision_directional == 1.0
    assert score(output, truth, tolerance_m=0.249).precision == 0.0


def test_a_zigzag_is_near_the_truth_but_goes_the_wrong_way():
    truth = line((0, 0, 0), (0, 0, 0.4))
    zigzag = document(
        [[0.015 * (-1) ** i, 0, 0.016 * i] for i in range(26)], list(pairwise(range(26)))
    )
    scores = score(zigzag, truth)
    assert scores.precision == 1.0
    assert scores.precision_directional < 0.15


def test_going_on_past_a_tip_is_not_right_in_the_strict_sense():
    truth = line((0, 0, 0), (0, 0, 0.4))
    beyond = document([[0, 0, 0], [0, 0, 0.415]], [[0, 1]])
    scores = score(beyond, truth)
    assert scores.precision_length == 1.0
    assert scores.precision_strict == pytest.approx(0.4015 / 0.415, abs=2e-3)


def test_strict_osr_asks_whether_any_observed_output_lies_beside():
    truth = line((0, 0, 0), (0, 0, 0.4))
    twice = document(
        [[0, 0, 0], [0, 0, 0.2], [0.004, 0, 0], [0.004, 0, 0.4]],
        [[0, 1], [2, 3]],
        occluded=np.array([False, False, True, True]),
    )
    scores = score(twice, truth)
    assert scores.osr == pytest.approx(0.4 / 0.6)
    assert scores.osr_strict == pytest.approx(0.2 / 0.6, abs=5e-3)


def gapped_truth() -> SkeletonDocument:
    """A 0.8 m line, 20 mm vertices: seen but for .3 < z < .5, of which .34 to .46 is hidden."""
    z = np.linspace(0, 0.8, 41)
    return line(
        (0, 0, 0),
        (0, 0, 0.8),
        segmented=((z < 0.31) | (z > 0.49)).tolist(),
        occluded=(z > 0.33) & (z < 0.47),
    )


def test_recall_is_split_by_what_the_views_showed():
    output = line((0, 0, 0), (0, 0, 0.39), 40)
    scores = score(output, gapped_truth())
    assert scores.recall_masked == pytest.approx(0.31 / 0.62, abs=0.01)
    assert scores.recall_unmasked == pytest.approx(0.10 / 0.18, abs=0.03)
    assert scores.recall_visible_unmasked == pytest.approx(0.02 / 0.04, abs=0.15)
    assert scores.recall_hidden == pytest.approx(0.08 / 0.14, abs=0.05)


def test_figures_that_need_masks_are_none_without_them():
    scores = score(line((0, 0, 0), (0, 0, 0.8)), replace(gapped_truth(), extra={}))
    assert scores.recall_masked is scores.recall_unmasked is scores.recall_visible_unmasked is None
    assert scores.gaps is scores.joined is None
    assert scores.recall_hidden == 1.0


def test_truth_no_view_could_frame_is_not_asked_for():
    truth = line((0, 0, 0), (0, 0, 0.8), framed=[z >= 0.41 for z in np.linspace(0, 0.8, 41)])
    scores = score(line((0, 0, 0.4), (0, 0, 0.8)), truth)
    assert scores.recall == scores.recall_length == scores.recall_vertices == 1.0
    whole = score(line((0, 0, 0), (0, 0, 0.8)), truth)
    assert whole.precision == 1.0


def stumps_and(bridge: list[list[float]]) -> SkeletonDocument:
    lower, upper = [[0, 0, 0], [0, 0, 0.3]], [[0, 0, 0.5], [0, 0, 0.8]]
    position = lower + bridge + upper
    edges = list(pairwise(range(len(position))))
    return document(position, edges if bridge else [edges[0], edges[-1]])


@pytest.mark.parametrize(
    ("output", "joined"),
    [
        (gapped_truth(), 1.0),
        (stumps_and([]), 0.0),
        (stumps_and([[0, 0, 0.4]]), 1.0),
        (stumps_and([[0.12, 0, 0.4]]), 1.0),  # 312 mm around a gap of 200: within 360
        (stumps_and([[0.2, 0, 0.4]]), 0.0),  # 447 mm
        (document([[0, 0, 0.3], [0, 0, 0.5]], [[0, 1]]), 1.0),
        (document([[0, 0, 0.33], [0, 0, 0.47]], [[0, 1]]), 0.0),  # reaches neither lip
        (document([[0.03, 0, 0], [0.03, 0, 0.8]], [[0, 1]]), 0.0),
    ],
    ids=["truth", "open", "straight", "detour", "long", "bridge", "floating", "beside"],
)
def test_a_gap_is_joined_by_a_path_that_is_not_much_longer(output, joined):
    scores = score(output, gapped_truth())
    assert (scores.gaps, scores.joined) == (1, joined)


def test_a_hole_with_three_lips_makes_two_gaps():
    arm = np.linspace(0.02, 0.2, 10)[:, None]
    directions = np.eye(3)
    truth = document(
        np.vstack([[[0, 0, 0]], *(arm * d for d in directions)]),
        [(0 if k == 0 else 10 * i + k, 10 * i + k + 1) for i in range(3) for k in range(10)],
        segmented=[False] + [k >= 2 + i for i in range(3) for k in range(10)],
    )
    assert score(truth, truth).gaps == 2
    first_two = replace(truth, edges=truth.edges[:20])
    assert score(first_two, truth).joined == 0.5


def test_a_gap_under_30_mm_is_none():
    truth = line((0, 0, 0), (0, 0, 0.4), segmented=[i != 20 for i in range(41)])
    assert score(truth, truth).gaps == 0
    assert score(truth, truth).joined is None


def test_radius_errors_are_relative_and_of_observed_pieces():
    truth = line((0, 0, 0), (0, 0, 0.4), radius=np.full(41, 0.01))
    output = line(
        (0, 0, 0),
        (0, 0, 0.4),
        radius=np.where(np.arange(41) < 20, 0.012, 0.5),
        occluded=np.arange(41) >= 20,
    )
    scores = score(output, truth)
    assert scores.radius_error_median == pytest.approx(0.2)


def test_calibration_tells_the_overconfident_from_the_honest():
    truth = line((0, 0, 0), (0, 0, 0.4))

    def half_right(confidence):
        return document(
            [[0, 0, 0], [0, 0, 0.4], [1, 0, 0], [1, 0, 0.4]],
            [[0, 1], [2, 3]],
            confidence=np.full(4, confidence),
            occluded=np.array([False, False, True, True]),
        )

    honest, bold = score(half_right(0.5), truth), score(half_right(1.0), truth)
    assert (honest.ece, honest.brier) == (pytest.approx(0.0, abs=1e-9), pytest.approx(0.25))
    assert (bold.ece, bold.brier) == (pytest.approx(0.5), pytest.approx(0.5))
    assert (honest.ece_occluded, bold.brier_occluded) == (pytest.approx(0.5), pytest.approx(1.0))


def fork(attached_at: int) -> SkeletonDocument:
    """A stem along z and a twig along x from z = 0.2, joined to the stem's vertex given."""
    stem = [[0, 0, 0.02 * i] for i in range(21)]
    twig = [[0.02 * i, 0, 0.2] for i in range(1, 11)]
    twig_chain = [attached_at, *range(21, 31)]
    return document(
        stem + twig,
        [*pairwise(range(21)), *pairwise(twig_chain)],
        branches=[range(21), twig_chain],
    )


def test_parents_are_right_when_the_way_down_is_the_truth_s():
    truth = fork(10)
    upside_down = replace(
        truth,
        branches=tuple(replace(b, vertices=b.vertices[::-1]) for b in truth.branches[:1]),
    )
    grafted = fork(20)
    assert score(truth, truth).parent_correct == 1.0
    assert score(upside_down, truth).parent_correct == 0.0
    assert 0.5 < score(grafted, truth).parent_correct < 0.95
    assert score(replace(truth, branches=()), truth).parent_correct is None


def test_components_and_cycles_are_reported():
    triangle = document(np.eye(3), [[0, 1], [1, 2], [2, 0]])
    assert not score(triangle, triangle).acyclic
    assert score(triangle, triangle).precision == 1.0
    two = document([*np.eye(3), [0, 0, 0]], [[0, 1], [2, 3]])
    assert (score(two, two).components, score(two, two).acyclic) == (2, True)


def test_a_tolerance_of_nothing_is_refused():
    with pytest.raises(UsageError, match="tolerance 0 m"):
        score(document([], []), document([], []), tolerance_m=0)


def test_flags_that_do_not_fit_the_vertices_are_refused():
    truth = line((0, 0, 0), (0, 0, 0.4), segmented=[True])
    with pytest.raises(DocumentError, match=r"vertices\.segmented has 1 entries for 41 vertices"):
        score(truth, truth)


def load_truth(path: Path) -> SkeletonDocument:
    with path.open("rb") as stream:
        attached = {a.name: a.data for a in make_reader(stream).iter_attachments()}
    body = json.loads(attached["ground_truth_skeleton.json"])
    vertices = body["vertices"]
    return document(
        vertices["position"],
        body["edges"],
        branches=[b["vertices"] for b in body["branches"]],
        radius=np.array(vertices["radius"]),
        occluded=np.array(vertices["occluded"]),
        segmented=vertices["segmented"],
    )


@pytest.fixture(params=["apple_fd2", "apple_dense", "oak_fd3", "walnut_stereo"])
def recorded_truth(request) -> SkeletonDocument:
    path = RECORDINGS / f"{request.param}.mcap"
    if not path.exists():
        pytest.skip(f"{path.name} of the shared data is not here")
    return load_truth(path)


def test_truth_cut_down_to_its_masked_pieces_scores_as_bounds_should(recorded_truth):
    masked = np.array(recorded_truth.extra["segmented"])
    seen = replace(recorded_truth, edges=recorded_truth.edges[masked[recorded_truth.edges].all(1)])
    bound = score(replace(seen, occluded=np.zeros_like(masked)), recorded_truth)
    assert bound.precision == bound.precision_directional == bound.recall_masked == 1.0
    assert (bound.joined, bound.osr) == (0.0, 0.0)
    assert bound.gaps >= 16
    assert 0.7 < bound.length_ratio < 0.9
    assert bound.recall_unmasked < 0.25
    assert bound.radius_error_mean < 1e-3
    whole = score(recorded_truth, recorded_truth)
    assert (whole.joined, whole.parent_correct, whole.length_ratio) == (1.0, 1.0, 1.0)
