"""What a recording holds, for a person or a program."""

from pathlib import Path
from typing import Any

from canopy_skel.document import RejectedView
from canopy_skel.errors import RecordingError
from canopy_skel.frame import View
from canopy_skel.recording import Recording, TopicOptions, read_recording


def inspect_recording(path: Path, topics: TopicOptions | None) -> dict[str, Any]:
    """Read a whole recording and return what is in it, ready for JSON.

    Raises:
        RecordingError: the file cannot be read at all.
    """
    recording = read_recording(path, topics)
    views, unusable = _views(recording)
    return {
        "recording": str(path),
        "scan_id": recording.scan_id,
        "metadata": dict(recording.metadata),
        "topics": [
            {"topic": t.topic, "schema": t.schema, "encoding": t.encoding, "messages": t.messages}
            for t in recording.topics
        ],
        "attachments": [a.name for a in recording.attachments],
        "views": views,
        "unusable_views": unusable,
        "warnings": list(recording.warnings),
    }


def _views(recording: Recording) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    views, unusable = [], []
    try:
        for view in recording.views():
            if isinstance(view, RejectedView):
                unusable.append({"index": view.index, "reason": view.reason})
            else:
                views.append(_facts(view))
    except RecordingError:
        # Said view by view already; inspecting such a file is not a failure.
        return views, unusable
    return views, unusable


def _facts(view: View) -> dict[str, Any]:
    depth = view.depth_m
    return {
        "index": view.index,
        "stamp_ns": view.stamp_ns,
        "size_px": [view.intrinsics.width_px, view.intrinsics.height_px],
        "camera_in_base_m": [round(float(x), 4) for x in view.base_from_camera[:3, 3]],
        "depth_share": None if depth is None else round(float((depth == depth).mean()), 4),
        "stereo": view.stereo is not None,
        "instances": None if view.scores is None else len(view.scores),
    }


def describe(facts: dict[str, Any]) -> str:
    """Return the facts as lines for a person."""
    lines = [f"{facts['recording']}: scan {facts['scan_id']}, {len(facts['views'])} usable views"]
    lines += [f"  {name}: {value}" for name, value in facts["metadata"].items()]
    lines += [f"  {t['topic']}  {t['schema']}  {t['messages']} messages" for t in facts["topics"]]
    lines += [f"  attached: {name}" for name in facts["attachments"]]
    for view in facts["views"]:
        depth = "stereo" if view["depth_share"] is None else f"depth {view['depth_share']:.0%}"
        masks = "no masks" if view["instances"] is None else f"{view['instances']} branch masks"
        lines.append(f"  view {view['index']}: {view['camera_in_base_m']} m, {depth}, {masks}")
    lines += [f"  unusable: {view['reason']}" for view in facts["unusable_views"]]
    lines += [f"  warning: {line}" for line in facts["warnings"]]
    return "\n".join(lines)
