"""Headers that negotiate: Accept, If-None-Match, Range, Prefer (RFC 9110, RFC 7240)."""

import re
from collections.abc import Sequence

LONGEST_WAIT_S = 60
_WAIT = re.compile(r"(?:^|[,;])\s*wait\s*=\s*\"?(\d{1,6})\"?\s*(?=$|[,;])")

_RANGE = re.compile(r"bytes=(\d{0,18})-(\d{0,18})", re.ASCII)


def best_media_type(accept: str, offered: Sequence[str]) -> str | None:
    """Return the offer that `Accept` likes best, the first of equals, None if it likes none."""
    ranges = [_media_range(part) for part in accept.split(",") if part.strip()]
    liked = [_quality(offer, ranges) for offer in offered]
    best = max(liked, default=0.0)
    return offered[liked.index(best)] if best > 0 else None


def matches(if_none_match: str, etag: str) -> bool:
    """Say whether one of the listed validators is `etag` (weak comparison)."""
    listed = [part.strip().removeprefix("W/") for part in if_none_match.split(",")]
    return "*" in listed or etag in listed


def byte_range(asked: str, size: int) -> range | None:
    """Return which of `size` bytes `Range` asks for, an empty range where they are not there.

    None: all of them; so it is without the header, and with one of several ranges or of none.
    """
    found = _RANGE.fullmatch(asked.replace(" ", ""))
    if found is None or not (found[1] or found[2]):
        return None
    if not found[1]:
        return range(max(0, size - int(found[2])), size)
    first, last = int(found[1]), int(found[2] or size)
    return range(first, min(last + 1, size)) if first <= last or not found[2] else None


def wait_s(prefer: str) -> int:
    """Return the seconds of `Prefer: wait=N`, at most a minute; 0 where it is not asked for."""
    found = _WAIT.search(prefer.lower())
    return min(int(found[1]), LONGEST_WAIT_S) if found else 0


def _media_range(part: str) -> tuple[str, float]:
    """Return a media range and its q; an unreadable q counts as 0."""
    name, *parameters = (piece.strip().lower() for piece in part.split(";"))
    for parameter in parameters:
        if parameter.startswith("q="):
            readable = re.fullmatch(r"[01](\.\d{0,3})?", parameter[2:])
            return name, float(parameter[2:]) if readable else 0.0
    return name, 1.0


def _quality(offer: str, ranges: Sequence[tuple[str, float]]) -> float:
    """Return the q of the most specific range that covers the offer."""
    quality_of = dict(reversed(ranges))
    for name in (offer, f"{offer.partition('/')[0]}/*", "*/*"):
        if name in quality_of:
            return quality_of[name]
    return 0.0
