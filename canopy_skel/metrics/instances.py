"""Judging branch instances in a picture: by their middle lines, their pixels and their scores.

Mask overlap punishes thin branches (a shift of one pixel on a width of four leaves 0.6), so an
instance counts as found when its line lies on the true one.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from canopy_skel.geometry import BoolArray, FloatArray, IntArray

TOLERANCE_PX = 3.0
TURN_DEG = 10.0
OVERLAP = 0.5
_STEP_PX = 2.0


@dataclass(frozen=True, kw_only=True, eq=False, slots=True)
class Judged:
    """The instances of one picture, matched.

    scores: (N,) of the predictions that count. found: (N,) whether they are a true instance, one
    to one; real: (N,) whether they are branches at all, be it part of one or two in a row.
    number: (N,) which predictions those are; one that covers only what is to be ignored does not
    count. matched: (truths,) which true instances were found.
    """

    scores: FloatArray
    found: BoolArray
    real: BoolArray
    number: IntArray
    matched: BoolArray

    @property
    def truths(self) -> int:
        """Return how many instances there were to find."""
        return len(self.matched)


def on_line(line: FloatArray, truth: FloatArray) -> float:
    """Return how well a line (N, 3: u, v, radius) lies on the true one, 0 = it does not.

    That is the smaller of the shares of either that lies within radius + 3 px of the other; it
    must exceed one half, and the lines must not differ by 10 degrees in direction.
    """
    if _turn_deg(line, truth) >= TURN_DEG:
        return 0.0
    reach = float(truth[:, 2].mean()) + TOLERANCE_PX
    of_line = float((_distance(_samples(line), truth) < reach).mean())
    of_truth = float((_distance(_samples(truth), line) < reach).mean())
    share = min(of_line, of_truth)
    return share if share > OVERLAP else 0.0


def _turn_deg(a: FloatArray, b: FloatArray) -> float:
    """Return the angle between the principal axes of two lines."""
    u, v = _axis(a), _axis(b)
    return float(np.degrees(np.arccos(min(abs(float(u @ v)), 1.0))))


def _axis(line: FloatArray) -> FloatArray:
    points = _samples(line)
    return np.asarray(np.linalg.eigh(np.cov(points.T))[1][:, 1])


def _samples(line: FloatArray) -> FloatArray:
    """Return points every two pixels along a line."""
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(line[:, :2], axis=0), axis=1))])
    stations = np.linspace(0.0, along[-1], max(int(along[-1] / _STEP_PX), 4) + 1)
    return np.stack([np.interp(stations, along, line[:, k]) for k in (0, 1)], axis=1)


def _distance(points: FloatArray, line: FloatArray) -> FloatArray:
    """Return (N,) distances of points from a polyline."""
    start, step = line[:-1, :2], np.diff(line[:, :2], axis=0)
    away = points[:, None] - start[None]
    share = np.sum(away * step, axis=2) / np.maximum(np.sum(step * step, axis=1), 1e-12)
    nearest = away - np.clip(share, 0, 1)[..., None] * step
    return np.asarray(np.sqrt(np.sum(nearest**2, axis=2)).min(axis=1))


def judge(
    lines: Sequence[FloatArray],
    scores: FloatArray,
    ignored: BoolArray,
    truths: Sequence[FloatArray],
) -> Judged:
    """Match predicted lines to true ones, the best scores first, each truth once.

    ignored: (N,) predictions that nobody is judged by unless they match.
    """
    found = np.zeros(len(lines), dtype=bool)
    matched = np.zeros(len(truths), dtype=bool)
    boxes = [_box(truth) for truth in truths]
    real = np.zeros(len(lines), dtype=bool)
    for number in np.argsort(-scores, kind="stable"):
        best, where = 0.0, -1
        low, high = _box(lines[number])
        near = [k for k, (a, b) in enumerate(boxes) if (low <= b).all() and (a <= high).all()]
        real[number] = _on_any(lines[number], [truths[k] for k in near]) > OVERLAP
        for k in near:
            share = 0.0 if matched[k] else on_line(lines[number], truths[k])
            if share > best:
                best, where = share, k
        if where >= 0:
            found[number], matched[where] = True, True
    counted = np.flatnonzero(found | real | ~ignored)
    return Judged(
        scores=scores[counted],
        found=found[counted],
        real=(found | real)[counted],
        number=counted,
        matched=matched,
    )


def _on_any(line: FloatArray, truths: Sequence[FloatArray]) -> float:
    """Return the share of a line that lies on true ones of about its direction."""
    points = _samples(line)
    on = np.zeros(len(points), dtype=bool)
    for truth in truths:
        if _turn_deg(line, truth) < 2 * TURN_DEG:
            on |= _distance(points, truth) < truth[:, 2].mean() + TOLERANCE_PX
    return float(on.mean())


def _box(line: FloatArray) -> tuple[FloatArray, FloatArray]:
    reach = float(line[:, 2].max()) + TOLERANCE_PX
    return line[:, :2].min(axis=0) - reach, line[:, :2].max(axis=0) + reach


def average_precision(judged: Sequence[Judged]) -> float:
    """Return the area under precision over recall of all pictures together; 0 without truths."""
    scores = np.concatenate([np.zeros(0), *(picture.scores for picture in judged)])
    found = np.concatenate([np.zeros(0, bool), *(picture.found for picture in judged)])
    truths = sum(picture.truths for picture in judged)
    if truths == 0 or len(scores) == 0:
        return 0.0
    hits = np.cumsum(found[np.argsort(-scores, kind="stable")])
    precision = hits / np.arange(1, len(hits) + 1)
    envelope = np.maximum.accumulate(precision[::-1])[::-1]
    recall = np.concatenate([[0.0], hits / truths])
    return float(np.sum(np.diff(recall) * envelope))


def precision_and_recall(judged: Sequence[Judged], least_score: float) -> tuple[float, float]:
    """Return both for the predictions with at least a score; precision is 1 if there are none.

    Precision is the share that is real, since what harms a map is a branch that is none; recall is
    the share of true instances found one to one.
    """
    hits = sum(int((p.found & (p.scores >= least_score)).sum()) for p in judged)
    real = sum(int((p.real & (p.scores >= least_score)).sum()) for p in judged)
    count = sum(int((p.scores >= least_score).sum()) for p in judged)
    truths = sum(picture.truths for picture in judged)
    return real / count if count else 1.0, hits / truths if truths else 0.0


def calibration_error(scores: FloatArray, real: BoolArray, bins: int = 10) -> float:
    """Return the expected calibration error: |share real - mean score|, weighed over bins."""
    if len(scores) == 0:
        return 0.0
    place = np.minimum((scores * bins).astype(np.int64), bins - 1)
    count = np.bincount(place, minlength=bins)
    apart = np.bincount(place, real, bins) - np.bincount(place, scores, bins)
    return float(np.abs(apart).sum() / count.sum())
