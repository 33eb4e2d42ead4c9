"""One mask for each branch out of the several that boxes give a slender, diagonal one.

Non-maximum suppression compares boxes, and those of neighbouring diagonal branches overlap much
more than the branches do; so duplicates survive it. The authors' code joins them by their masks,
and so does this (Kantor-Lab/tree_skeletonization: `filter_overlapping_masks` twice, then
`merge_masks`).
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from canopy_skel.segment import BranchMask

_FIRST_PASSES = (0.5, 0.5)
_LAST = 0.7


def merged(masks: Sequence[BranchMask]) -> list[BranchMask]:
    """Join masks of which one lies mostly on the other; the score of a union is the mean.

    More than half twice over, then more than 70 % until no such pair is left.
    """
    result = list(masks)
    for least in _FIRST_PASSES:
        result = _joined_once(result, least)
    while True:
        fewer = _joined_once(result, _LAST)
        if len(fewer) == len(result):
            return result
        result = fewer


def _joined_once(masks: list[BranchMask], least: float) -> list[BranchMask]:
    """Let every mask take up those after it that overlap it."""
    rest, result = masks, []
    while rest:
        own, others = rest[0], []
        for other in rest[1:]:
            if _overlap(own, other) > least:
                own = _union(own, other)
            else:
                others.append(other)
        result.append(own)
        rest = others
    return result


def _overlap(a: BranchMask, b: BranchMask) -> float:
    """Return the common share of the smaller of two masks."""
    top, left = max(a.top_px, b.top_px), max(a.left_px, b.left_px)
    bottom = min(a.top_px + a.mask.shape[0], b.top_px + b.mask.shape[0])
    right = min(a.left_px + a.mask.shape[1], b.left_px + b.mask.shape[1])
    if bottom <= top or right <= left:
        return 0.0
    parts = [
        one.mask[top - one.top_px : bottom - one.top_px, left - one.left_px : right - one.left_px]
        for one in (a, b)
    ]
    return float((parts[0] & parts[1]).sum() / max(min(a.mask.sum(), b.mask.sum()), 1))


def _union(a: BranchMask, b: BranchMask) -> BranchMask:
    top, left = min(a.top_px, b.top_px), min(a.left_px, b.left_px)
    bottom = max(a.top_px + a.mask.shape[0], b.top_px + b.mask.shape[0])
    right = max(a.left_px + a.mask.shape[1], b.left_px + b.mask.shape[1])
    mask = np.zeros((bottom - top, right - left), dtype=np.bool_)
    for one in (a, b):
        height, width = one.mask.shape
        v, u = one.top_px - top, one.left_px - left
        mask[v : v + height, u : u + width] |= one.mask
    return BranchMask(
        instance=a.instance,
        left_px=left,
        top_px=top,
        mask=mask,
        confidence=(a.confidence + b.confidence) / 2,
    )


def disjoint(masks: Sequence[BranchMask], size: tuple[int, int]) -> list[BranchMask]:
    """Give pixels that several masks claim to the surest one, and number what is left 1, 2, ….

    size: (height, width) of the picture.
    """
    taken = np.zeros(size, dtype=np.bool_)
    result: list[BranchMask] = []
    for mask in sorted(masks, key=lambda mask: -mask.confidence):
        height, width = mask.mask.shape
        part = taken[mask.top_px : mask.top_px + height, mask.left_px : mask.left_px + width]
        own = mask.mask & ~part
        part |= own
        if own.any():
            result.append(replace(mask, instance=len(result) + 1, mask=own))
    return result
