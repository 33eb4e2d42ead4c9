"""What the routes work with, and the checks they share."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from fastapi import Depends, Request
from numpy.typing import ArrayLike

from service.bell import Bell
from service.http.requests import SpeedCaps
from service.pictures import Pictures
from service.rig import Rig
from service.scans import Scans


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Context:
    """Everything behind the routes."""

    rig: Rig
    scans: Scans
    bell: Bell
    pictures: Pictures
    paths: Mapping[str, Sequence[ArrayLike]]
    caps: SpeedCaps
    segmenter: str
    uploads: Path


async def _context(request: Request) -> Context:
    context: Context = request.app.state.context
    return context


Here = Annotated[Context, Depends(_context)]


def known_scan(scan_id: str, here: Here) -> str:
    """Return the id of a scan that there is; UnknownScanError otherwise."""
    return here.scans.record(scan_id).scan_id


KnownScan = Annotated[str, Depends(known_scan)]
