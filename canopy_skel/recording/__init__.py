"""Recordings (MCAP): read, write, recover and cut; nothing else in the method touches files."""

from canopy_skel.recording.annotate import annotate
from canopy_skel.recording.carry import carry_over
from canopy_skel.recording.decode import view_from_messages
from canopy_skel.recording.encode import EncodedPicture, encode_view
from canopy_skel.recording.options import ROS2_TOPICS, TopicOptions
from canopy_skel.recording.reader import (
    Recording,
    TopicSummary,
    metadata_of,
    read_recording,
)
from canopy_skel.recording.recover import RecoverReport, cut_recording, recover
from canopy_skel.recording.single_view import messages_of_view
from canopy_skel.recording.writer import RecordingWriter

__all__ = [
    "ROS2_TOPICS",
    "EncodedPicture",
    "Recording",
    "RecordingWriter",
    "RecoverReport",
    "TopicOptions",
    "TopicSummary",
    "annotate",
    "carry_over",
    "cut_recording",
    "encode_view",
    "messages_of_view",
    "metadata_of",
    "read_recording",
    "recover",
    "view_from_messages",
]
