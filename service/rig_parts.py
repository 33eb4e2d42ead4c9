"""What a rig of this machine is made of."""

from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from canopy_skel.geometry import FloatArray
from canopy_skel.messages import Message
from drivers.guarded_arm import Limits
from drivers.protocols import Arm, Camera
from service.rig import PartStatus, ScanSpec
from service.scan import Attachments, Stage


class Feed(Protocol):
    """Where views go to become a skeleton; nothing here may block."""

    def begin(self, spec: ScanSpec, path: Path) -> None:
        """A scan begins, or goes on; its recording grows at `path` (`.part`)."""
        ...

    def catch_up(self, spec: ScanSpec, path: Path) -> None:
        """A scan has ended without its whole skeleton; its recording is at `path` (`.part`)."""
        ...

    def leave(self, scan_id: str) -> None:
        """Nothing more of such a scan is wanted."""
        ...

    def offer(self, scan_id: str, index: int, messages: Sequence[Message]) -> None:
        """A view is safe on disk; with its messages as recorded, where they are at hand."""
        ...

    def skeleton(self, scan_id: str) -> bytes | None:
        """Return the newest skeleton document, None while there is none."""
        ...

    def worker(self) -> PartStatus:
        """Say whether a worker is there."""
        ...

    def flush(self, timeout_s: float) -> bool:
        """Wait until the skeleton of everything offered is here; say whether it is."""
        ...


@dataclass(frozen=True, kw_only=True, eq=False, slots=True)
class RigParts:
    """What a rig is made of; see also `ScanTools`. data: folder of the recordings."""

    arm: Arm
    camera: Camera
    limits: Limits
    tool_from_camera: FloatArray
    feed: Feed
    data: Path
    attachments: Attachments = lambda exposed_ns: {}
    stage: Stage = lambda name: nullcontext()
