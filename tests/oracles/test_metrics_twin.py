"""The point-matching figures again, comparing everything with everything."""

from dataclasses import dataclass

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from canopy_skel.document import Method, SkeletonDocument
from canopy_skel.metrics import score

SPACING_M = 0.008
TOLERANCE_M = 0.02


def star(seed: int, shift: float) -> SkeletonDocument:
    """Grow straight arms of odd lengths from one middle: each arm is one chain of one edge."""
    rng = np.random.default_rng(seed)
    count = int(rng.integers(3, 8))
    directions = rng.normal(size=(count, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    tips = rng.uniform(0.02, 0.15, (count, 1)) * directions
    n = count + 1
    return SkeletonDocument(
        scan_id="star",
        revision=0,
        method=Method(name="test"),
        views_used=0,
        views_rejected=(),
        position=np.vstack([np.zeros((1, 3)), tips]) + shift * rng.normal(size=(n, 3)),
        radius=rng.uniform(0.002, 0.02, n),
        occluded=rng.random(n) < 0.5,
        confidence=rng.random(n),
        edges=np.array([(0, i) for i in range(1, n)]),
        branches=(),
        root=0,
        components=1,
    )


@dataclass
class Piece:
    point: np.ndarray
    direction: np.ndarray
    length: float
    edge: int
    at: float


def pieces(tree: SkeletonDocument, spacing: float) -> list[Piece]:
    result = []
    for e, (a, b) in enumerate(tree.position[tree.edges]):
        length = float(np.linalg.norm(b - a))
        count = int(np.ceil(length / spacing))
        for k in range(count):
            at = (k + 0.5) / count
            point, direction = a + at * (b - a), (b - a) / length
            result.append(Piece(point, direction, length / count, e, at))
    return result


def to_curve(point, tree) -> float:
    best = np.inf
    for a, b in tree.position[tree.edges]:
        at = np.clip(np.dot(point - a, b - a) / np.dot(b - a, b - a), 0, 1)
        best = min(best, float(np.linalg.norm(point - a - at * (b - a))))
    return best


def occluded(tree, piece: Piece) -> bool:
    a, b = tree.edges[piece.edge]
    if abs(piece.at - 0.5) < 1e-9:
        return bool(tree.occluded[a] and tree.occluded[b])
    return bool(tree.occluded[b] if piece.at > 0.5 else tree.occluded[a])


def beside(piece: Piece, others: list[Piece]) -> bool:
    for other in others:
        offset = other.point - piece.point
        distance = float(np.linalg.norm(offset))
        if distance <= TOLERANCE_M and (
            distance < 0.002 or abs(offset @ piece.direction) < 0.5 * distance
        ):
            return True
    return False


def mean(values, weights) -> float:
    return float(np.average(values, weights=weights))


def naive_scores(output, truth) -> dict[str, float]:
    out, true = pieces(output, SPACING_M), pieces(truth, SPACING_M)
    fine_out, fine_true = pieces(output, 0.001), pieces(truth, 0.001)
    out_off = np.array([to_curve(p.point, truth) for p in out])
    true_off = np.array([to_curve(p.point, output) for p in true])
    right, found = out_off <= TOLERANCE_M, true_off <= TOLERANCE_M
    hidden = [occluded(output, p) for p in out]
    both = [r and h for r, h in zip(right, hidden, strict=True)]
    along = [
        any(
            np.linalg.norm(q.point - p.point) <= TOLERANCE_M
            and abs(q.direction @ p.direction) >= np.sqrt(0.5)
            for q in true
        )
        for p in out
    ]
    observed = [p for p in fine_out if not occluded(output, p)]
    strict = [beside(p, fine_true) for p in fine_out]
    alone = [
        s and occluded(output, p) and not beside(p, observed)
        for s, p in zip(strict, fine_out, strict=True)
    ]
    out_m, true_m = [p.length for p in out], [p.length for p in true]
    f1 = []
    for tolerance in np.arange(0.002, 0.031, 0.002):
        p, r = mean(out_off <= tolerance, out_m), mean(true_off <= tolerance, true_m)
        f1.append(2 * p * r / (p + r) if p + r else 0.0)
    apart = np.linalg.norm(output.position[:, None] - truth.position[None], axis=2)
    return {
        "precision": np.mean(right),
        "recall": np.mean(found),
        "osr": np.mean(both),
        "precision_vertices": np.mean((apart <= TOLERANCE_M).any(1)),
        "recall_vertices": np.mean((apart <= TOLERANCE_M).any(0)),
        "precision_length": mean(right, out_m),
        "recall_length": mean(found, true_m),
        "precision_directional": mean(along, out_m),
        "precision_strict": mean(strict, [p.length for p in fine_out]),
        "osr_strict": mean(alone, [p.length for p in fine_out]),
        "length_ratio": sum(out_m) / np.dot(found, true_m) if any(found) else None,
        "auc": np.mean(f1),
    }


@settings(max_examples=10, deadline=None)
@given(st.integers(0, 2**32 - 1), st.sampled_from([0.003, 0.01, 0.03]))
def test_the_fast_figures_are_the_naive_ones(seed, shift):
    truth, output = star(seed, 0.0), star(seed, shift)
    scores = score(output, truth).to_dict()
    for name, value in naive_scores(output, truth).items():
        assert scores[name] == pytest.approx(value, abs=1e-9), name
