"""Hand-eye calibration from a recording in which a board stands still before the rig."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from canopy_skel.document import RejectedView
from canopy_skel.errors import RecordingError
from canopy_skel.frame import View
from canopy_skel.geometry import FloatArray, invert
from canopy_skel.recording import Recording, TopicOptions, read_recording
from drivers.board import Board, CornerFinder
from drivers.hand_eye import (
    FEWEST_CORNERS,
    FITTING_PX,
    BoardView,
    HandEye,
    apart,
    calibrate,
)

MOST_STD_M, MOST_STD_DEG = 0.001, 0.1
"""What is accepted: the errors with which all figures on simulated trees were measured."""
MOST_SCALE_STD, MOST_SCALE_OFF = 0.001, 0.005
"""Measured on synthetic views: with a scale known to 0.1 % little was 1 mm wrong, nothing 1.3. A
scale that is off is no error of the result, but says that the board is not the one that was
measured."""


@dataclass(frozen=True, kw_only=True, eq=False, slots=True)
class Calibration:
    """What came of it. seen: the views used or left out. unseen: index and why, of the others.

    believed: the (4, 4) tool_from_camera that the recording was made with. square_m: the side of
    the board's squares, as it was said.
    """

    hand_eye: HandEye
    seen: tuple[BoardView, ...]
    unseen: tuple[tuple[int, str], ...]
    believed: FloatArray
    square_m: float

    @property
    def doubts(self) -> tuple[str, ...]:
        """Why it is not accepted, and what to do about it; nothing if it is."""
        found = self.hand_eye
        if found.middle_px > FITTING_PX:  # what else is said of such views means nothing
            return ("the views do not fit each other: did the board move?",)
        doubts = []
        if found.scale_std > MOST_SCALE_STD:
            doubts.append(
                f"the size of the board is uncertain by {100 * found.scale_std:.2f} %: views all at"
                " one distance? vary it from 0.35 to 0.7 m"
            )
        elif abs(found.scale - 1) > MOST_SCALE_OFF:
            doubts.append(
                f"the board's squares seem to be {1e3 * self.square_m * found.scale:.2f} mm, not"
                f" {1e3 * self.square_m:.2f}: measure across the whole board and divide"
                "; if that is right, the focal length is as wrong"
            )
        if found.position_std_m > MOST_STD_M or found.turn_std_deg > MOST_STD_DEG:
            doubts.append(
                f"more uncertain than {1e3 * MOST_STD_M:g} mm or {MOST_STD_DEG:g}°: take more"
                " views, nearer to the board, tilted and rolled more"
            )
        return tuple(doubts)

    @property
    def accepted(self) -> bool:
        """Whether it is as sure as the method wants it."""
        return not self.doubts


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
        if (lack := _lack_of(corners, board)) is not None:
            unseen.append((view.index, lack))
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
        square_m=board.square_m,
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
        "doubts": list(result.doubts),
        "position_std_m": found.position_std_m,
        "turn_std_deg": found.turn_std_deg,
        "scale": found.scale,
        "scale_std": found.scale_std,
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
    facts, found = facts_of(result), result.hand_eye
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
        f"The board is {100 * found.scale:.2f} ± {100 * found.scale_std:.2f} % as large as said.",
    ]
    if result.accepted:
        lines += ["For [camera] of the rig file:", rig_file_line(found.tool_from_camera)]
    else:
        lines += [f"Not accepted: {doubt}" for doubt in result.doubts]
    return "\n".join(lines)


def _lack_of(corners: FloatArray, board: Board) -> str | None:
    """Return why a view with these (N, 3) corners will not do, None if it does.

    Corners along one line fit any tilt about it.
    """
    if len(corners) < FEWEST_CORNERS:
        return f"{len(corners)} corners of the board are seen"
    spread_m = np.linalg.svd(corners[:, :2] - corners[:, :2].mean(axis=0), compute_uv=False)
    if spread_m[1] < board.square_m:
        return f"the {len(corners)} corners of the board that are seen lie along one line"
    return None


def _flange(recording: Recording, view: View) -> FloatArray:
    options = recording.options
    try:
        return recording.transforms.lookup(options.base_frame, options.tool_frame, view.stamp_ns)
    except ValueError as error:
        raise RecordingError(
            f"{recording.path}: view {view.index} does not say where {options.tool_frame} was"
            f" ({error}); name the flange's frame with --topic tool_frame=NAME"
        ) from error
