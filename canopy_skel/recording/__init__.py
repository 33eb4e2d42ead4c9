"""Recordings (MCAP): read, write, recover and cut; nothing else in the method touches files."""

from canopy_skel.recording.options import ROS2_TOPICS, TopicOptions
from canopy_skel.recording.reader import Recording, TopicSummary, read_recording

__all__ = ["ROS2_TOPICS", "Recording", "TopicOptions", "TopicSummary", "read_recording"]
