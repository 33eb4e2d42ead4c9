"""Scoring a skeleton document against the ground truth."""

from canopy_skel.metrics.scores import Scores, score

__all__ = ["Scores", "score"]
