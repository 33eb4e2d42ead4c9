"""Hand-eye calibration from a recording in which a board stands still before the rig."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from scipy.spatial.transform import Rotation

from canopy_skel.document import RejectedView
from canopy_skel.errors import RecordingError
from canopy_skel.frame import View
from canopy_skel.geometry import FloatArray, invert
from canopy_skel.recording import Recording, TopicOptions, read_recording
from drivers.board import Board, CornerFinder
from drivers.hand_eye import FEWEST_CORNERS, BoardView, HandEye, apart, calibrate

MOST_STD_M, MOST_STD_DEG = 0.001, 0.1
"""What is accepted: the errors with which all figures on simulated trees were measured."""


@dataclass(frozen=True, kw_only=True, eq=False, slots=True)
class Calibration:
    """What came of it. seen: the views used or left out. unseen: index and why, of the others.

    believed: the (4, 4) tool_from_camera that the recording was made with.
    """

    hand_eye: HandEye
    seen: tuple[BoardView, ...]
    unseen: tuple[tuple[int, str], ...]
    believed: FloatArray

    @property
    def accepted(self) -> bool:
        """Whether it is as sure as the method wants it."""
        return (
            self.hand_eye.position_std_m <= MOST_STD_M
            and self.hand_eye.turn_std_deg <= MOST_STD_DEG
        )


def calibrate_recording(path: Path, board: Board, topics: TopicOptions | None) -> Calibration:
    """Return where the camera of a recording is on the flange.

    Raises:
        RecordingError: it cannot be read, or does not say where the flange was.
        CalibrationError: its views do not show enough.
    """
    recording = read_recording(path, topics)
    finder = CornerFinder(board)
    seen, unseen, cameras = [], [], []
    for view in recording.views():
        if isinstance(view, RejectedView):
            unseen.append((view.index, view.reason))
            continue
        base_from_tool0 = _flange(recording, view)
        corners, pixels = finder.find(view.color_rgb)
        if len(corners) < FEWEST_CORNERS:
            unseen.append((view.index, f"{len(corners)} corners of the board are seen"))
            continue
        cameras.append(view.base_from_camera)
        seen.append(
            BoardView(
                index=view.index,
                base_from_tool0=base_from_tool0,
                intrinsics=view.intrinsics,
                corners_in_board=corners,
                pixels=pixels,
            )
        )
    hand_eye = calibrate(seen)
    return Calibration(
        hand_eye=hand_eye,
        seen=tuple(seen),
        unseen=tuple(unseen),
        believed=invert(seen[0].base_from_tool0) @ cameras[0],
    )


def rig_file_line(tool_from_camera: FloatArray) -> str:
    """Return the line of a rig file's [camera] that says where the camera is."""
    position = ", ".join(f"{value:.6f}" for value in tool_from_camera[:3, 3])
    turn = Rotation.from_matrix(tool_from_camera[:3, :3]).as_quat(canonical=True)
    quaternion = ", ".join(f"{value:.7f}" for value in turn)
    return f"tool_from_camera = {{ position = [{position}], quaternion_xyzw = [{quaternion}] }}"


def facts_of(result: Calibration) -> dict[str, Any]:
    """Return what came of it, ready for JSON."""
    found = result.hand_eye
    moved_m, turned_deg = apart(result.believed, found.tool_from_camera)
    return {
        "tool_from_camera": found.tool_from_camera.tolist(),
        "accepted": result.accepted,
        "position_std_m": found.position_std_m,
        "turn_std_deg": found.turn_std_deg,
        "moved_m": moved_m,
        "turned_deg": turned_deg,
        "views": [
            {
                "index": view.index,
                "corners": len(view.pixels),
                "residual_px": float(residual_px),
                "used": bool(used),
            }
            for view, residual_px, used in zip(
                result.seen, found.residual_px, found.used, strict=True
            )
        ],
        "unseen": [{"index": index, "reason": reason} for index, reason in result.unseen],
    }


def described(result: Calibration) -> str:
    """Return what came of it, for a person."""
    facts = facts_of(result)
    lines = ["view  corners  residual px"]
    for view in facts["views"]:
        left_out = "" if view["used"] else "  left out: did the arm or the board move?"
        lines.append(
            f"{view['index']:4}  {view['corners']:7}  {view['residual_px']:11.2f}{left_out}"
        )
    lines += [f"{one['index']:4}  {one['reason']}" for one in facts["unseen"]]
    lines += [
        f"It differs by {1e3 * facts['moved_m']:.2f} mm and {facts['turned_deg']:.3f}° from what"
        " the recording was made with,",
        f"and is uncertain by {1e3 * facts['position_std_m']:.2f} mm and"
        f" {facts['turn_std_deg']:.3f}° (leaving out one view after the other).",
    ]
    if result.accepted:
        lines += ["For [camera] of the rig file:", rig_file_line(result.hand_eye.tool_from_camera)]
    else:
        lines.append(
            f"Not accepted: more than {1e3 * MOST_STD_M:g} mm or {MOST_STD_DEG:g}°. Take more"
            " views, nearer to the board, tilted and rolled more."
        )
    return "\n".join(lines)


def _flange(recording: Recording, view: View) -> FloatArray:
    options = recording.options
    try:
        return recording.transforms.lookup(options.base_frame, options.tool_frame, view.stamp_ns)
    except ValueError as error:
        raise RecordingError(
            f"{recording.path}: view {view.index} does not say where {options.tool_frame} was"
            f" ({error}); name the flange's frame with --topic tool_frame=NAME"
        ) from error
