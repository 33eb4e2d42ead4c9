"""Recordings with truth, made ready to fit confidences to."""

from pathlib import Path

from canopy_skel.canopy import CanopyConfig, CanopyScan
from canopy_skel.document import from_json
from canopy_skel.errors import RecordingError, UsageError
from canopy_skel.fitting import Lesson, truth_points
from canopy_skel.frame import View
from canopy_skel.likelihood import LikelihoodConfig, LikelihoodMap, segments_of
from canopy_skel.recording import read_recording
from canopy_skel.wood import wood_of
from drivers.stereo import with_depth
from service.skeletons import SEGMENTERS


def lesson_from(path: Path, segmenter: str) -> Lesson:
    """Read a recording and take all its views in.

    Raises:
        RecordingError: it cannot be read, or has no truth.
        UsageError: there is no such segmenter.
    """
    if segmenter not in SEGMENTERS:
        known = ", ".join(SEGMENTERS)
        raise UsageError(f"unknown segmenter {segmenter!r}: choose one of {known}")
    recording = read_recording(path)
    if recording.ground_truth is None:
        raise RecordingError(
            f"{path}: no true skeleton is attached; record it with canopy simulate"
        )
    finder, scan = SEGMENTERS[segmenter](), CanopyScan(CanopyConfig())
    likelihood = LikelihoodMap(LikelihoodConfig())
    for view in recording.views():
        if isinstance(view, View):
            usable = with_depth(view)
            seen = scan.observe(usable, finder.segment(usable), wood_of(finder, usable))
            likelihood.add(segments_of(seen.splines))
            scan.add(view.index, seen)
    truth = truth_points(from_json(recording.ground_truth, str(path)))
    return Lesson(scan=scan, likelihood=likelihood, truth=truth)
