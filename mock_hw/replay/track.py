"""Where a recording was taken from."""

from dataclasses import dataclass

import numpy as np

from canopy_skel.errors import RecordingError
from canopy_skel.frame import View
from canopy_skel.geometry import FloatArray, invert
from canopy_skel.recording import Recording
from drivers.kinematics import relative_turn, rotation_vector

NEAR_M = 1e-3
NEAR_RAD = 2e-3


@dataclass(frozen=True, kw_only=True, eq=False, slots=True)
class Station:
    """A view of the recording by its index, and the (4, 4) pose of the flange that shows it."""

    index: int
    base_from_tool0: FloatArray


@dataclass(frozen=True, kw_only=True, eq=False, slots=True)
class Track:
    """The usable views of a recording as places to drive to.

    tool_from_camera: (4, 4), its hand-eye calibration; identity where it knows no flange, whose
    place the camera then takes.
    """

    recording: Recording
    stations: tuple[Station, ...]
    tool_from_camera: FloatArray

    def at(self, base_from_tool0: FloatArray) -> tuple[Station, ...]:
        """Return the stations at a pose of the flange, within a millimetre and 2 mrad."""
        return tuple(one for one in self.stations if _near(one.base_from_tool0, base_from_tool0))

    def nearest_m(self, base_from_tool0: FloatArray) -> tuple[Station, float]:
        """Return the station nearest to a pose, and how far it is."""
        here = base_from_tool0[:3, 3]
        away = [float(np.linalg.norm(one.base_from_tool0[:3, 3] - here)) for one in self.stations]
        nearest = int(np.argmin(away))
        return self.stations[nearest], away[nearest]


def read_track(recording: Recording) -> Track:
    """Return the track of a recording, every view decoded once.

    Raises:
        RecordingError: none of its views is usable.
    """
    tool_from_camera: FloatArray | None = None
    stations = []
    for view in recording.views():
        if isinstance(view, View):
            if tool_from_camera is None:
                tool_from_camera = _tool_from_camera(recording, view)
            pose = view.base_from_camera @ invert(tool_from_camera)
            stations.append(Station(index=view.index, base_from_tool0=pose))
    if tool_from_camera is None:
        raise RecordingError(f"{recording.path}: no usable view to replay")
    return Track(recording=recording, stations=tuple(stations), tool_from_camera=tool_from_camera)


def _tool_from_camera(recording: Recording, view: View) -> FloatArray:
    """Return the hand-eye transform that view was taken with.

    It leads to the undistorted pinhole of the view, which may be turned against the lens.
    """
    options = recording.options
    try:
        base_from_tool0 = recording.transforms.lookup(
            options.base_frame, options.tool_frame, view.stamp_ns
        )
    except ValueError:
        return np.eye(4)
    return invert(base_from_tool0) @ view.base_from_camera


def _near(one: FloatArray, other: FloatArray) -> bool:
    away_m = float(np.linalg.norm(one[:3, 3] - other[:3, 3]))
    turned_rad = float(np.linalg.norm(rotation_vector(relative_turn(one, other))))
    return away_m < NEAR_M and turned_rad < NEAR_RAD
