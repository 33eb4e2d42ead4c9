"""Which scans of the catalogue lack the skeleton of all their views, for want of a worker."""

import json
import logging
from collections.abc import Collection, Iterator

from canopy_skel.errors import UsageError
from service.catalogue import Catalogue, RevisionRecord, ScanRecord
from service.rig import CAUGHT_UP, RigError, ScanKind, ScanSpec
from service.specs import spec_from

LOOK_BACK = 200
"""How many of the newest scans are looked at."""
MOST_FAILURES = 3
"""How often a scan is given up before it is left alone: the fault may have been the worker's."""
_log = logging.getLogger(__name__)


def incomplete(catalogue: Catalogue, interrupted: Collection[str]) -> Iterator[ScanSpec]:
    """Yield what lacks views and can be hoped to get them, oldest first; then open replays.

    Args:
        catalogue: already recovered.
        interrupted: ids of scans that were under way when the service ended; they may have views
            that the catalogue was not told of.
    """
    scans = catalogue.scans(LOOK_BACK, kind=ScanKind.SCAN)
    for record in reversed([*catalogue.unfinished(ScanKind.REPLAY), *scans]):
        due = record.kind is ScanKind.REPLAY or record.scan_id in interrupted
        if not due and not _lacks_views(catalogue, record):
            continue
        try:
            yield spec_from(record.scan_id, record.request)
        except (KeyError, TypeError, ValueError, UsageError, RigError) as error:
            _log.warning("scan %s: its request cannot be read (%r)", record.scan_id, error)


def _lacks_views(catalogue: Catalogue, record: ScanRecord) -> bool:
    newest = catalogue.newest_revision(record.scan_id)
    known = 0 if newest is None else _views_known(newest)
    return known < record.views_done and not _was_caught_up(catalogue, record)


def _views_known(newest: RevisionRecord) -> int:
    """Return how many views a skeleton has used or rejected; none if it is not the exact one."""
    try:
        document = json.loads(newest.path.read_bytes())
    except (OSError, ValueError) as error:
        _log.warning("%s cannot be read (%s); it is made again", newest.path, error)
        return 0
    views = document["views"]
    return 0 if document.get("preview") else views["used"] + len(views["rejected"])


def _was_caught_up(catalogue: Catalogue, record: ScanRecord) -> bool:
    """Say whether all its views have been fed, or given up often enough."""
    ends = [
        event.data["fields"]
        for event in catalogue.events(record.scan_id, after=0)
        if event.kind == CAUGHT_UP and event.data["views_done"] >= record.views_done
    ]
    return len(ends) >= MOST_FAILURES or any(
        end["views"] >= record.views_done and not end["refused"] for end in ends
    )
