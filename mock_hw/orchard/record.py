"""A simulated scan as a recording, with its truth attached."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from canopy_skel.document import SkeletonDocument, to_json
from canopy_skel.recording import RecordingWriter
from canopy_skel.recording.reader import GROUND_TRUTH
from mock_hw.orchard.simulate import Simulation, shots, truth_of
from mock_hw.orchard.truth import nothing_seen, seen_also


def record(simulation: Simulation, path: Path, metadata: Mapping[str, str]) -> SkeletonDocument:
    """Photograph a scan into a new recording; return the truth that was attached to it.

    Pictures and truth come from one drawing of each view. The same simulation and metadata give
    the same bytes.

    Args:
        simulation: what to photograph.
        path: the recording to make.
        metadata: of the scan, beside its `scan_id`.

    Raises:
        RecordingError: the file cannot be written, or is there already.
    """
    facts = {"scan_id": simulation.scan_id, **metadata}
    seen = nothing_seen(simulation.scene.tree)
    with RecordingWriter(path, facts, tool_from_camera=simulation.tool_from_camera) as recording:
        for shot in shots(simulation):
            recording.write_view(shot.view)
            seen = seen_also(seen, shot.picture.vertex, shot.fragments)
        document = truth_of(simulation, seen)
        recording.attach(GROUND_TRUTH, "application/json", to_json(document))
    return document


def segmented_share(truth: SkeletonDocument) -> float:
    """Return the share of the framed true skeleton that some instance of the scan covers."""
    segmented, framed = (np.array(truth.extra[key], dtype=bool) for key in ("segmented", "framed"))
    return float(segmented[framed].mean())
