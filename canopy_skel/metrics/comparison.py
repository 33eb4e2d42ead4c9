"""An output beside its truth, both cut into pieces, and the shares that follow from distances."""

from dataclasses import dataclass

import numpy as np

from canopy_skel.document import SkeletonDocument
from canopy_skel.errors import DocumentError
from canopy_skel.geometry import BoolArray, FloatArray, IntArray
from canopy_skel.metrics.matching import Feet, any_within, beside, feet_on, nearest, parallel, share
from canopy_skel.metrics.pieces import Pieces, chains_of, simple_edges

CURVE_SPACING_M = 0.001
AUC_TOLERANCES_M = np.arange(2, 31, 2) / 1000


@dataclass(frozen=True, kw_only=True, eq=False, slots=True)
class Side:
    """One of the two documents: positions (V, 3), simple edges (E, 2), pieces, and 1 mm pieces."""

    document: SkeletonDocument
    positions: FloatArray
    edges: IntArray
    pieces: Pieces
    curve: Pieces

    def flags(self, name: str) -> BoolArray | None:
        """Return an extra array of flags (V,), None where the document has none of that name.

        Raises:
            DocumentError: it does not have one entry per vertex.
        """
        values = self.document.extra.get(name)
        if values is None:
            return None
        if len(values) != len(self.positions):
            raise DocumentError(
                f"skeleton document {self.document.scan_id!r}: vertices.{name} has {len(values)} "
                f"entries for {len(self.positions)} vertices; give one per vertex or leave it out"
            )
        return np.asarray(values, dtype=np.bool_)


def side_of(document: SkeletonDocument, spacing_m: float) -> Side:
    """Cut a document into pieces of at most `spacing_m`, and of 1 mm."""
    edges = simple_edges(document.edges)
    chains = chains_of(document.position, edges)
    return Side(
        document=document,
        positions=document.position,
        edges=edges,
        pieces=chains.pieces(spacing_m),
        curve=chains.pieces(CURVE_SPACING_M),
    )


@dataclass(frozen=True, kw_only=True, eq=False, slots=True)
class Comparison:
    """An output beside its truth.

    right: (N,) output pieces with truth within the tolerance. predicted: (N,) output pieces no
    view showed. found: (M,) truth pieces with output within it. framed: (M,) truth pieces that
    recalls count. out_feet: of the output pieces on the truth; true_m: (M,) distance of the truth
    pieces to the output's curve. Both are infinite beyond the largest tolerance.
    """

    out: Side
    true: Side
    tolerance_m: float
    out_feet: Feet
    true_m: FloatArray
    right: BoolArray
    predicted: BoolArray
    found: BoolArray
    framed: BoolArray

    def counts(self) -> tuple[float | None, float | None, float | None]:
        """Return precision, recall and OSR, counting pieces."""
        one = np.ones(len(self.right))
        return (
            share(self.right, one),
            share(self.found, np.ones(len(self.found)), among=self.framed),
            share(self.right & self.predicted, one),
        )

    def vertex_counts(self) -> tuple[float | None, float | None, float | None]:
        """Return precision, recall and OSR, counting vertices against vertices."""
        right = nearest(self.out.positions, self.true.positions, self.tolerance_m)[0] < np.inf
        found = nearest(self.true.positions, self.out.positions, self.tolerance_m)[0] < np.inf
        one = np.ones(len(right))
        return (
            share(right, one),
            share(found, np.ones(len(found)), among=self.true.flags("framed")),
            share(right & self.out.document.occluded, one),
        )

    def directional_precision(self, degrees: float) -> float | None:
        """Return the share of output with a truth piece within the tolerance and `degrees`."""
        out, true = self.out.pieces, self.true.pieces
        accept = parallel(out.directions, true.directions, degrees)
        right = any_within(out.points, true.points, self.tolerance_m, accept)
        return share(right, out.length_m)

    def strict(self) -> tuple[float | None, float | None]:
        """Return precision and OSR by the authors' evaluation (see `matching.beside`)."""
        out, true = self.out.curve, self.true.curve
        accept = beside(out.points, out.directions, true.points)
        right = any_within(out.points, true.points, self.tolerance_m, accept)
        hidden = out.flag(self.out.document.occluded)
        asked = np.flatnonzero(right & hidden)
        seen = out.points[~hidden]
        accept = beside(out.points[asked], out.directions[asked], seen)
        predicted = np.zeros(len(right), dtype=np.bool_)
        predicted[asked] = ~any_within(out.points[asked], seen, self.tolerance_m, accept)
        return share(right, out.length_m), share(predicted, out.length_m)

    def recalls(self) -> tuple[float | None, float | None, float | None, float | None]:
        """Return the recall of masked, unmasked, visible but unmasked, and hidden framed truth."""
        pieces, segmented = self.true.pieces, self.true.flags("segmented")
        hidden = pieces.flag(self.true.document.occluded)

        def recall(among: BoolArray) -> float | None:
            return share(self.found, pieces.length_m, among=self.framed & among)

        if segmented is None:
            return None, None, None, recall(hidden)
        masked = pieces.flag(segmented)
        return recall(masked), recall(~masked), recall(~masked & ~hidden), recall(hidden)

    def detectable(self) -> float | None:
        """Return the share of framed truth that some mask covers (V_det)."""
        segmented = self.true.flags("segmented")
        if segmented is None:
            return None
        pieces = self.true.pieces
        return share(pieces.flag(segmented), pieces.length_m, among=self.framed)

    def length_ratio(self) -> float | None:
        """Return the length of the output over the length of the truth it covers."""
        covered_m = float(self.true.pieces.length_m[self.found].sum())
        return float(self.out.pieces.length_m.sum()) / covered_m if covered_m > 0 else None

    def f1_area(self) -> float | None:
        """Return the mean F1 of the length-weighted precision and recall over the tolerances."""
        scores = []
        for tolerance_m in AUC_TOLERANCES_M.tolist():
            recall = share(self.true_m <= tolerance_m, self.true.pieces.length_m, among=self.framed)
            if recall is None:
                return None
            precision = (
                share(self.out_feet.distance_m <= tolerance_m, self.out.pieces.length_m) or 0.0
            )
            total = precision + recall
            scores.append(2 * precision * recall / total if total > 0 else 0.0)
        return float(np.mean(scores))

    def radius_errors(self) -> tuple[float | None, float | None]:
        """Return median and mean of |r - r_true| / r_true over right observed pieces."""
        chosen = self.right & ~self.predicted
        if not chosen.any():
            return None, None
        truth = self.out_feet.blend(self.true.document.radius)[chosen]
        error = np.abs(self.out.pieces.blend(self.out.document.radius)[chosen] - truth)
        relative = error[truth > 0] / truth[truth > 0]
        if len(relative) == 0:
            return None, None
        return float(np.median(relative)), float(np.mean(relative))


def compare(
    document: SkeletonDocument, truth: SkeletonDocument, *, tolerance_m: float, spacing_m: float
) -> Comparison:
    """Cut both documents into pieces and measure how far each lies from the other's curve."""
    out, true = side_of(document, spacing_m), side_of(truth, spacing_m)
    reach_m = max(tolerance_m, float(AUC_TOLERANCES_M[-1])) + CURVE_SPACING_M
    out_feet = feet_on(out.pieces.points, true.curve, true.positions, reach_m)
    true_m = feet_on(true.pieces.points, out.curve, out.positions, reach_m).distance_m
    framed = true.flags("framed")
    return Comparison(
        out=out,
        true=true,
        tolerance_m=tolerance_m,
        out_feet=out_feet,
        true_m=true_m,
        right=out_feet.distance_m <= tolerance_m,
        predicted=out.pieces.flag(document.occluded),
        found=true_m <= tolerance_m,
        framed=np.ones(len(true_m), np.bool_) if framed is None else true.pieces.flag(framed),
    )
