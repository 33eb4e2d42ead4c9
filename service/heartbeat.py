"""What a worker says of itself twice a second, and the order of the skeletons it publishes."""

import json
from dataclasses import asdict, dataclass

from canopy_skel.messages import encode_json
from service.bus import BusError

PERIOD_S = 0.5
SCANS_KEPT = 2
"""How many scans a worker keeps: those it worked on last."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Version:
    """How much a document knows: views in it, views rejected, not just a preview."""

    revision: int = 0
    rejected: int = 0
    exact: bool = True

    def encode(self) -> bytes:
        """Return the bytes that go with a document on the bus."""
        return encode_json(asdict(self))

    @property
    def order(self) -> tuple[int, int, bool]:
        """What to sort by."""
        return (self.revision, self.rejected, self.exact)


@dataclass(frozen=True, kw_only=True, slots=True)
class Heartbeat:
    """A worker at a moment.

    scan_id: of the scan it worked on last, empty before the first; views, rejected, revision and
    config_sha256 are of that scan. busy: there is work in hand or waiting. progress: grows with
    every step of the method. problem: the last sample that could not be used, empty if none.
    """

    id: str
    pid: int
    scan_id: str = ""
    config_sha256: str = ""
    views: tuple[int, ...] = ()
    rejected: tuple[int, ...] = ()
    revision: int = 0
    busy: bool = False
    progress: int = 0
    problem: str = ""

    def encode(self) -> bytes:
        """Return the JSON of the heartbeat."""
        return encode_json(asdict(self))


def decode_heartbeat(data: bytes) -> Heartbeat:
    """Return the heartbeat that some bytes hold.

    Raises:
        BusError: they hold none.
    """
    try:
        fields = json.loads(data)
        fields["views"], fields["rejected"] = tuple(fields["views"]), tuple(fields["rejected"])
        return Heartbeat(**fields)
    except (ValueError, TypeError, KeyError) as error:
        raise BusError(f"worker heartbeat: cannot be read ({error}); run one version") from error


def decode_version(data: bytes) -> Version:
    """Return the version that came with a document.

    Raises:
        BusError: there is none.
    """
    try:
        fields = json.loads(data)
        return Version(
            revision=int(fields["revision"]),
            rejected=int(fields["rejected"]),
            exact=bool(fields.get("exact", True)),
        )
    except (ValueError, TypeError, KeyError) as error:
        raise BusError(f"skeleton: its attachment cannot be read ({error})") from error
