"""Segmenters by name: which there are, and what each needs."""

from dataclasses import replace
from pathlib import Path

from canopy_skel.errors import UsageError
from canopy_skel.segment import Segmenter
from canopy_skel.segmenters.recorded import RecordedSegmenter

NAMES = ("recorded", "unet", "maskrcnn")


def make_segmenter(name: str, weights: Path | None = None) -> Segmenter:
    """Return a segmenter that reports what its weights say is sure enough.

    Raises:
        UsageError: there is none of that name, it needs other weights, or what it needs is not
            installed.
    """
    return _made(name, weights, every=False)[0]


def make_for_judging(name: str, weights: Path | None = None) -> tuple[Segmenter, float]:
    """Return a segmenter that reports everything however unsure, and what it reports by default.

    Raises:
        UsageError: as `make_segmenter`.
    """
    return _made(name, weights, every=True)


def _made(name: str, weights: Path | None, *, every: bool) -> tuple[Segmenter, float]:
    if name not in NAMES:
        raise UsageError(f"unknown segmenter {name!r}: choose one of {', '.join(NAMES)}")
    if name == "recorded":
        if weights is not None:
            raise UsageError("the recorded segmenter has no weights; choose unet or maskrcnn")
        return RecordedSegmenter(), 0.0
    # Imported where they are needed: torch takes seconds to load.
    if name == "unet":
        from canopy_skel.segmenters.unet.segmenter import UNetSegmenter
        from canopy_skel.segmenters.unet.weights import BUILTIN, load

        model = load(BUILTIN if weights is None else weights)
        least = model.least_score
        return UNetSegmenter(replace(model, least_score=0.0) if every else model), least
    if weights is None:
        raise UsageError("the maskrcnn segmenter comes without weights; train it, then --weights")
    from canopy_skel.segmenters.maskrcnn.segmenter import MaskRcnnSegmenter
    from canopy_skel.segmenters.maskrcnn.weights import load as load_maskrcnn

    detector = load_maskrcnn(weights)
    least = detector.least_score
    return MaskRcnnSegmenter(replace(detector, least_score=0.0) if every else detector), least
