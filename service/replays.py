"""Replays over HTTP: a recording that is there becomes a skeleton, and no arm moves."""

import json
from dataclasses import replace
from pathlib import Path

from canopy_skel.errors import RecordingError
from canopy_skel.messages import TOPICS
from canopy_skel.recording import Recording, read_recording
from service.catalogue import RevisionRecord
from service.rig import CAUGHT_UP, FINISHED, RigEvent, ScanState, ScanStatus


def replayable(path: Path) -> Recording:
    """Return a recording whose views can go over the bus as they are.

    Raises:
        RecordingError: it cannot be read, has no whole view, or holds other messages than canopy's.
    """
    recording = read_recording(path)
    mend = "replay it where it lies, with `canopy replay`, which knows other messages too"
    if recording.file.profile == "ros2":
        raise RecordingError(f"ROS 2 wrote it; {mend}")
    for channel in recording.file.channels.values():
        topic = TOPICS.get(channel.topic)
        schema = recording.file.schema_of(channel.id).name
        if topic is not None and schema != topic.schema:
            raise RecordingError(f"{channel.topic} holds {schema}, not {topic.schema}; {mend}")
    if not whole_views(recording):
        raise RecordingError("it has no whole view; `canopy inspect` says what it has")
    return recording


def whole_views(recording: Recording) -> int:
    """Return how many views there are to send."""
    return sum(not group.partial for group in recording.groups)


def has_masks(recording: Recording) -> bool:
    """Say whether somebody's branch masks are in it."""
    return any("instances" in group.refs for group in recording.groups)


def _views_of(newest: RevisionRecord | None) -> int:
    if newest is None:
        return 0
    views = json.loads(newest.path.read_bytes())["views"]
    return int(views["used"]) + len(views["rejected"])


def status_after(event: RigEvent, status: ScanStatus, newest: RevisionRecord | None) -> ScanStatus:
    """Return where a replay is when something was told of it.

    newest: its newest skeleton; views that it uses or rejects are done.
    """
    if status.state in FINISHED:
        return status
    done = replace(status, views_done=_views_of(newest))
    if event.kind != CAUGHT_UP:
        return done
    if newest is None:
        why = "no view of it is usable; `canopy inspect` and the worker's log say why"
        return replace(done, state=ScanState.FAILED, detail=why)
    refused = event.fields["refused"]
    detail = f"no worker could take views {refused}" if refused else ""
    return replace(done, state=ScanState.DONE, detail=detail)
