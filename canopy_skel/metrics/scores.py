"""Scores of a skeleton document against the ground truth: see docs/metrics.md."""

from dataclasses import asdict, dataclass

from canopy_skel.document import SkeletonDocument
from canopy_skel.errors import UsageError
from canopy_skel.metrics.calibration import brier_score, expected_calibration_error
from canopy_skel.metrics.comparison import Comparison, compare
from canopy_skel.metrics.joining import SeenTree, find_gaps, joined_gaps
from canopy_skel.metrics.matching import share
from canopy_skel.metrics.topology import components_and_acyclic, parent_correct

SHORTEST_GAP_M = 0.03
WITHIN_DEGREES = 45.0


@dataclass(frozen=True, kw_only=True, slots=True)
class Scores:
    """Figures of one output against one truth; None where there is nothing to take a share of.

    "Right" is an output piece with truth within the tolerance, "found" a truth piece with output
    within it. Pieces are the skeleton resampled evenly between forks and tips. Recalls leave out
    truth that is not `framed`.

    precision, recall, osr: the paper's (section IV), counting pieces: right / all; found / all;
        right and predicted / all of the output.
    precision_vertices, recall_vertices, osr_vertices: the same, counting vertices of the documents
        against vertices.
    precision_length, recall_length: the same, each piece weighted by the length it stands for.
        All figures below are weighted so.
    precision_directional: share of output pieces that some truth piece within the tolerance is
        within 45 degrees of, regardless of sense.
    precision_strict, osr_strict: the authors' own evaluation. At 1 mm: right needs truth within the
        tolerance that lies beside (|cos| of its offset to the output's direction < 0.5) or within
        2 mm; predicted means that no observed output passes that test.
    recall_masked, recall_unmasked: of truth that is, or is not, `segmented`.
    recall_visible_unmasked: of truth that is neither `segmented` nor `occluded`.
    recall_hidden: of truth that is `occluded`.
    v_det: share of the framed truth that is `segmented`: what a perfect front end would find.
    v_det_ratio: recall_length / v_det, above 1 when more is found than any mask showed.
    occ_precision: share right of the predicted output.
    gaps: gaps of at least 30 mm between masked parts of the truth (`joining.find_gaps`).
    joined: share of these, by number, that the output connects (`joining.joined_gaps`).
    length_ratio: length of the output / length of truth with output within the tolerance.
    auc: mean of F1 = 2PR/(P+R) of the length-weighted P and R at tolerances 2, 4, ... 30 mm.
    radius_error_median, radius_error_mean: of |r - r_true| / r_true over right observed pieces,
        r_true at the nearest truth, by number.
    ece, brier: of confidence as the chance to be right; ECE over ten equal bins.
    ece_occluded, brier_occluded: the same of the predicted output.
    parent_correct: share of the output whose way to the root goes down the truth
        (`topology.parent_correct`).
    components, acyclic: of the output.
    output_length_m, truth_length_m, tolerance_m, spacing_m: what was compared, and how.
    """

    precision: float | None
    recall: float | None
    osr: float | None
    precision_vertices: float | None
    recall_vertices: float | None
    osr_vertices: float | None
    precision_length: float | None
    recall_length: float | None
    precision_directional: float | None
    precision_strict: float | None
    osr_strict: float | None
    recall_masked: float | None
    recall_unmasked: float | None
    recall_visible_unmasked: float | None
    recall_hidden: float | None
    v_det: float | None
    v_det_ratio: float | None
    occ_precision: float | None
    gaps: int | None
    joined: float | None
    length_ratio: float | None
    auc: float | None
    radius_error_median: float | None
    radius_error_mean: float | None
    ece: float | None
    brier: float | None
    ece_occluded: float | None
    brier_occluded: float | None
    parent_correct: float | None
    components: int
    acyclic: bool
    output_length_m: float
    truth_length_m: float
    tolerance_m: float
    spacing_m: float

    def to_dict(self) -> dict[str, float | int | bool | None]:
        """Return the figures by name, ready for JSON."""
        return asdict(self)


def score(
    document: SkeletonDocument,
    truth: SkeletonDocument,
    *,
    tolerance_m: float = 0.02,
    spacing_m: float = 0.008,
) -> Scores:
    """Score a skeleton document against the ground truth, both in the same frame.

    The truth's `occluded` flags and its extra arrays `segmented` (a mask covers the vertex) and
    `framed` (some view could show it; all where absent) split the recalls; without `segmented`
    the figures that need it are None. Vertices without edges have no length and count only in the
    figures of vertices. Of an output without length, precisions are None and recalls 0.

    Args:
        document: the output.
        truth: the ground truth, acyclic.
        tolerance_m: the distance up to which points correspond.
        spacing_m: longest piece when resampling.

    Raises:
        UsageError: the tolerance or the spacing is not positive.
        DocumentError: an extra array of the truth does not have one entry per vertex.
    """
    if not (tolerance_m > 0 and spacing_m > 0):
        raise UsageError(
            f"tolerance {tolerance_m} m and spacing {spacing_m} m must both be greater than 0"
        )
    both = compare(document, truth, tolerance_m=tolerance_m, spacing_m=spacing_m)
    return _figures(both, spacing_m)


def _figures(both: Comparison, spacing_m: float) -> Scores:
    out, true = both.out, both.true
    precision, recall, osr = both.counts()
    precision_vertices, recall_vertices, osr_vertices = both.vertex_counts()
    precision_strict, osr_strict = both.strict()
    gaps, joined = _gaps(both, spacing_m)
    radius_error_median, radius_error_mean = both.radius_errors()
    recall_masked, recall_unmasked, recall_visible_unmasked, recall_hidden = both.recalls()
    recall_length = share(both.found, true.pieces.length_m, among=both.framed)
    v_det = both.detectable()
    components, acyclic = components_and_acyclic(len(out.positions), out.document.edges)
    all_m = out.pieces.length_m
    (ece, brier), (ece_occluded, brier_occluded) = _calibration(both)
    return Scores(
        precision=precision,
        recall=recall,
        osr=osr,
        precision_vertices=precision_vertices,
        recall_vertices=recall_vertices,
        osr_vertices=osr_vertices,
        precision_length=share(both.right, all_m),
        recall_length=recall_length,
        precision_directional=both.directional_precision(WITHIN_DEGREES),
        precision_strict=precision_strict,
        osr_strict=osr_strict,
        recall_masked=recall_masked,
        recall_unmasked=recall_unmasked,
        recall_visible_unmasked=recall_visible_unmasked,
        recall_hidden=recall_hidden,
        v_det=v_det,
        v_det_ratio=recall_length / v_det if v_det and recall_length is not None else None,
        occ_precision=share(both.right, all_m, among=both.predicted),
        gaps=gaps,
        joined=joined,
        length_ratio=both.length_ratio(),
        auc=both.f1_area(),
        radius_error_median=radius_error_median,
        radius_error_mean=radius_error_mean,
        ece=ece,
        brier=brier,
        ece_occluded=ece_occluded,
        brier_occluded=brier_occluded,
        parent_correct=_parents(both, spacing_m),
        components=components,
        acyclic=acyclic,
        output_length_m=float(all_m.sum()),
        truth_length_m=float(true.pieces.length_m.sum()),
        tolerance_m=both.tolerance_m,
        spacing_m=spacing_m,
    )


def _calibration(both: Comparison) -> list[tuple[float | None, float | None]]:
    """Return ECE and Brier score of the whole output, and of what of it is predicted."""
    out = both.out
    confidence = out.pieces.blend(out.document.confidence)
    return [
        (
            expected_calibration_error(confidence, both.right, weight),
            brier_score(confidence, both.right, weight),
        )
        for weight in (out.pieces.length_m, out.pieces.length_m * both.predicted)
    ]


def _parents(both: Comparison, spacing_m: float) -> float | None:
    return parent_correct(
        both.out.document,
        both.true.document,
        tolerance_m=both.tolerance_m,
        spacing_m=spacing_m,
    )


def _gaps(both: Comparison, spacing_m: float) -> tuple[int | None, float | None]:
    out, true = both.out, both.true
    masked = true.flags("segmented")
    if masked is None:
        return None, None
    tree = SeenTree(positions=true.positions, edges=true.edges, seen=masked)
    gaps = [gap for gap in find_gaps(tree) if gap.length_m >= SHORTEST_GAP_M]
    joined = joined_gaps(
        gaps,
        tree,
        out.positions,
        out.edges,
        tolerance_m=both.tolerance_m,
        spacing_m=spacing_m,
    )
    return len(gaps), sum(joined) / len(gaps) if gaps else None
