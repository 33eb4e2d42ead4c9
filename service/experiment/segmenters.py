"""Segmenters an experiment can name: all that replay knows, and recorded masks made worse."""

import re

from canopy_skel.errors import UsageError
from canopy_skel.segment import Segmenter
from canopy_skel.segmenters.degraded import DegradedSegmenter
from canopy_skel.segmenters.recorded import RecordedSegmenter
from service.skeletons import SEGMENTERS

_DEGRADED = re.compile(r"(?:drop(?P<drop>\d+))?\+?(?:false(?P<false>\d+))?")


def degradation(name: str) -> tuple[int, int] | None:
    """Return percent dropped and percent false of a name like drop25+false20; None if not one."""
    if name == "recorded":
        return 0, 0
    match = _DEGRADED.fullmatch(name)
    if name in SEGMENTERS or match is None or not (match["drop"] or match["false"]):
        return None
    if bool(match["drop"] and match["false"]) != ("+" in name):
        return None
    return int(match["drop"] or 0), int(match["false"] or 0)


def segmenter_named(name: str) -> Segmenter:
    """Return a new segmenter.

    Raises:
        UsageError: nobody knows it, or it would drop more than there is.
    """
    if name in SEGMENTERS:
        return SEGMENTERS[name]()
    shares = degradation(name)
    if shares is None or shares[0] > 100:
        raise UsageError(
            f"unknown segmenter {name!r}: choose from {', '.join(SEGMENTERS)}, or recorded masks"
            " made worse as drop25, false20 or drop25+false20 (percent of the instances)"
        )
    drop, false = shares
    return DegradedSegmenter(
        inner=RecordedSegmenter(), drop_share=drop / 100, false_share=false / 100
    )
