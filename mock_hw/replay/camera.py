"""A camera that shows the view of the place where the replay arm stands."""

import time
from collections import Counter
from collections.abc import Callable
from types import TracebackType
from typing import Self

from canopy_skel.document import RejectedView
from canopy_skel.errors import RecordingError
from canopy_skel.frame import View
from drivers.errors import CameraTimeoutError, NoCameraError
from drivers.protocols import CameraImage, ToolPose
from mock_hw.replay.track import Station, Track

_POLL_S = 0.002


class ReplayCamera:
    """The pictures of a recording; see `drivers.protocols.Camera`.

    Pixels, depth, stereo pair, masks and scores are those of the view; only the stamp is new.
    Between two places of the recording there is no picture. Views of one place come in turn.
    """

    def __init__(self, track: Track, arm_pose: Callable[[], ToolPose]) -> None:
        self._track = track
        self._arm_pose = arm_pose
        self._open = False
        self._shown: Counter[int] = Counter()

    def __enter__(self) -> Self:
        """Look whether the recording is still there.

        Raises:
            NoCameraError: it is not, or not what it was.
        """
        self._view(self._track.stations[0])
        self._open = True
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        """Show nothing any more."""
        self._open = False

    def check(self) -> None:
        """Raise NoCameraError outside the `with` block."""
        if not self._open:
            raise NoCameraError("the camera is not open: use it inside its `with` block")

    def grab(self, timeout_s: float) -> CameraImage:
        """Return the picture of where the arm stands, waiting until it stands at one."""
        self.check()
        called_ns = time.monotonic_ns()
        until_s = time.perf_counter() + timeout_s
        while True:
            pose = self._arm_pose()
            stations = self._track.at(pose.base_from_tool0)
            if time.perf_counter() > until_s:
                raise CameraTimeoutError(self._why_none(pose, stations, timeout_s))
            if stations and pose.stamp_ns > called_ns:
                return self._show(stations, pose.stamp_ns)
            time.sleep(_POLL_S)

    def _show(self, stations: tuple[Station, ...], stamp_ns: int) -> CameraImage:
        station = min(stations, key=lambda one: self._shown[one.index])
        view = self._view(station)
        self._shown[station.index] += 1
        return CameraImage(
            stamp_ns=stamp_ns,
            color_rgb=view.color_rgb,
            intrinsics=view.intrinsics,
            depth_m=view.depth_m,
            stereo=view.stereo,
            instances=view.instances,
            scores=view.scores,
        )

    def _view(self, station: Station) -> View:
        try:
            view = self._track.recording.view(station.index)
        except RecordingError as error:
            raise NoCameraError(str(error)) from error
        if isinstance(view, RejectedView):
            raise NoCameraError(f"{self._track.recording.path}: {view.reason}")
        return view

    def _why_none(self, pose: ToolPose, stations: tuple[Station, ...], timeout_s: float) -> str:
        if stations:
            return f"the arm has not said within {timeout_s} s where it is"
        nearest, away_m = self._track.nearest_m(pose.base_from_tool0)
        return (
            f"the arm stands at no view of {self._track.recording.path.name}; view"
            f" {nearest.index} is {away_m:.3f} m away: move it there"
        )
