"""A rig that is a recording: an arm that drives to its views, a camera that shows them."""

from mock_hw.replay.arm import ReplayArm
from mock_hw.replay.camera import ReplayCamera
from mock_hw.replay.track import Station, Track, read_track

__all__ = ["ReplayArm", "ReplayCamera", "Station", "Track", "read_track"]
