"""How far confidences can be believed."""

import numpy as np

from canopy_skel.geometry import BoolArray, FloatArray


def expected_calibration_error(
    confidence: FloatArray, right: BoolArray, weight: FloatArray, bins: int = 10
) -> float | None:
    """Return the weighted mean of |share right - mean confidence| over equal bins of confidence.

    Args:
        confidence: (N,) in [0, 1].
        right: (N,).
        weight: (N,); None is returned when it sums to nothing.
        bins: number of equal-width bins; 1.0 belongs to the last.
    """
    total = float(weight.sum())
    if total <= 0:
        return None
    which = np.clip((confidence * bins).astype(np.int64), 0, bins - 1)
    excess = np.bincount(which, weights=weight * (right - confidence), minlength=bins)
    return float(np.abs(excess).sum()) / total


def brier_score(confidence: FloatArray, right: BoolArray, weight: FloatArray) -> float | None:
    """Return the weighted mean of (confidence - right)²; arguments as for the calibration error."""
    total = float(weight.sum())
    return float((weight * (confidence - right) ** 2).sum()) / total if total > 0 else None
