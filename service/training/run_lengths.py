"""COCO's run lengths: a mask as lengths of runs, column by column, starting with zeros.

The compressed form writes each length (from the third on: its difference to the last but one) in
groups of five bits, low ones first, as characters from "0" on; bit 6 says that more follow, and
the highest bit of the last group is the sign. (After `maskApi.c` of the COCO API.)
"""

from collections.abc import Sequence

import numpy as np

from canopy_skel.geometry import BoolArray

_GROUP_BITS, _MORE, _SIGN, _FIRST = 5, 0x20, 0x10, 48
_MOST_GROUPS = 12


def decoded(counts: Sequence[int] | str, height: int, width: int) -> BoolArray:
    """Return the (height, width) mask that run lengths stand for, plain or compressed.

    Raises:
        ValueError: they are not run lengths of a mask of this size.
    """
    lengths = _decompressed(counts) if isinstance(counts, str) else list(counts)
    if not all(isinstance(length, int) and length >= 0 for length in lengths):
        raise ValueError("has run lengths that are not whole numbers from 0 up")
    if sum(lengths) != height * width:
        raise ValueError(f"has run lengths of {sum(lengths)} pixels, not of the whole picture")
    values = np.arange(len(lengths)) % 2 == 1
    return np.repeat(values, lengths).reshape(width, height).T


def _decompressed(text: str) -> list[int]:
    lengths: list[int] = []
    value, groups = 0, 0
    for character in text:
        group = ord(character) - _FIRST
        if not 0 <= group < 2 * _MORE or groups == _MOST_GROUPS:
            raise ValueError(f"has {character!r} in compressed run lengths, where it cannot stand")
        value |= (group & (_MORE - 1)) << (_GROUP_BITS * groups)
        groups += 1
        if not group & _MORE:
            if group & _SIGN:
                value -= 1 << (_GROUP_BITS * groups)
            lengths.append(value + lengths[-2] if len(lengths) > 2 else value)
            value, groups = 0, 0
    if groups:
        raise ValueError("has compressed run lengths that end in the middle of a number")
    return lengths
