"""What happens in a scan and where the arm is, on the bus, for whoever listens."""

import logging
import threading
import time
from collections.abc import Callable
from types import TracebackType
from typing import Self

import zenoh

from canopy_skel.messages import BASE_FRAME, TOOL_FRAME, encode_json, encode_pose
from canopy_skel.recording.encode import stamped_transform
from drivers.protocols import ToolPose
from service.bus import ENCODING_JSON, Keys
from service.rig import RigEvent

ENCODING_POSE = "application/protobuf;foxglove.PoseInFrame"
POSE_PERIOD_S = 0.1
STOP_TIMEOUT_S = 1.0
_log = logging.getLogger(__name__)


class Broadcast:
    """Puts events, and the pose while a scan is under way, on the bus; nobody has to listen.

    A listener that stalls loses samples and holds nothing up: the journal in the recording and the
    events over HTTP are the ones that are complete.

    Args:
        session: an open bus session.
        keys: of the rig.
        pose: returns the id of the scan under way and the newest pose of the flange; None while
            there is neither.
    """

    def __init__(
        self, session: zenoh.Session, keys: Keys, pose: Callable[[], tuple[str, ToolPose] | None]
    ) -> None:
        self._session, self._keys, self._pose = session, keys, pose
        self._epoch_ns = time.time_ns() - time.monotonic_ns()
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name="pose broadcast", daemon=True)

    def __enter__(self) -> Self:
        """Start to tell poses."""
        self._thread.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        """Stop telling poses."""
        self._stopping.set()
        self._thread.join(STOP_TIMEOUT_S)

    def event(self, event: RigEvent) -> None:
        """Put an event of a scan on the bus; returns at once."""
        if event.scan_id:
            data = encode_json({"kind": event.kind, **event.fields})
            self._put(self._keys.event(event.scan_id), data, ENCODING_JSON)

    def _run(self) -> None:
        while not self._stopping.wait(POSE_PERIOD_S):
            here = self._pose()
            if here is not None:
                scan_id, pose = here
                stamp_ns = pose.stamp_ns + self._epoch_ns
                moved = stamped_transform(stamp_ns, BASE_FRAME, TOOL_FRAME, pose.base_from_tool0)
                self._put(self._keys.pose(scan_id), encode_pose(moved), ENCODING_POSE)

    def _put(self, key: str, data: bytes, encoding: str) -> None:
        try:
            self._session.put(
                key, data, encoding=encoding, congestion_control=zenoh.CongestionControl.DROP
            )
        except zenoh.ZError as error:
            _log.warning("%s is not told: %s", key, error)
