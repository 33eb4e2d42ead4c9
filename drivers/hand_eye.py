"""Hand-eye calibration: where the camera sits on the flange, from views of a board at rest.

The solution is that of Park and Martin ("Robot sensor calibration: solving AX = XB on the
Euclidean group", IEEE Transactions on Robotics and Automation, 1994), over all pairs of views.
Moving it until the corners' pixels fit best makes it worse: errors of the arm's poses, not of the
pixels, are what differs between views, and pixels hardly tell a tilt from a shift.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from canopy_skel.errors import CanopyError
from canopy_skel.frame import Intrinsics
from canopy_skel.geometry import BoolArray, FloatArray, invert, transform_from, transform_points

FEWEST_VIEWS = 6
FEWEST_CORNERS = 6
LEAST_TURN_DEG = 10.0
_OUTLIER_PX, _OUTLIER_MEDIANS = 2.0, 4.0


class CalibrationError(CanopyError):
    """The views do not tell where the camera is; the message says which others would."""


@dataclass(frozen=True, kw_only=True, eq=False, slots=True)
class BoardView:
    """What one picture shows of the board.

    base_from_tool0: (4, 4), where the flange was. corners_in_board: (N, 3) metres. pixels: (N, 2),
    where they are seen.
    """

    index: int
    base_from_tool0: FloatArray
    intrinsics: Intrinsics
    corners_in_board: FloatArray
    pixels: FloatArray


@dataclass(frozen=True, kw_only=True, eq=False, slots=True)
class HandEye:
    """The camera on the flange.

    tool_from_camera, base_from_board: (4, 4). residual_px: (V,) of each view, how far its corners
    are from where they should be (root mean square). used: (V,) which views it is made of; the
    others fit none of the rest. position_std_m, turn_std_deg: how uncertain tool_from_camera is,
    by leaving out one view after the other (jackknife); errors that all views share are not in it.
    """

    tool_from_camera: FloatArray
    base_from_board: FloatArray
    residual_px: FloatArray
    used: BoolArray
    position_std_m: float
    turn_std_deg: float


@dataclass(frozen=True, eq=False, slots=True)
class _Poses:
    """base_from_tool0, camera_from_board: (V, 4, 4)."""

    base_from_tool0: FloatArray
    camera_from_board: FloatArray

    def only(self, chosen: BoolArray) -> "_Poses":
        return _Poses(self.base_from_tool0[chosen], self.camera_from_board[chosen])


def calibrate(views: Sequence[BoardView]) -> HandEye:
    """Return where the camera is, from views with at least FEWEST_CORNERS corners each.

    Raises:
        CalibrationError: too few views, or the camera was hardly turned, or about one axis only.
    """
    _require_enough(len(views))
    poses = _Poses(
        np.array([view.base_from_tool0 for view in views]),
        np.array([_camera_from_board(view) for view in views]),
    )
    used = np.ones(len(views), dtype=np.bool_)
    while True:
        _require_turns(poses.only(used))
        tool_from_camera = _park_martin(poses.only(used))
        base_from_board = _mean_board(poses.only(used), tool_from_camera)
        residual_px = np.array(
            [_residual_px(view, tool_from_camera, base_from_board) for view in views]
        )
        worst = int(np.argmax(np.where(used, residual_px, 0)))
        if residual_px[worst] <= max(
            _OUTLIER_PX, _OUTLIER_MEDIANS * float(np.median(residual_px[used]))
        ):
            break
        used[worst] = False
        _require_enough(int(used.sum()))
    position_std_m, turn_std_deg = _jackknife(poses.only(used), tool_from_camera)
    return HandEye(
        tool_from_camera=tool_from_camera,
        base_from_board=base_from_board,
        residual_px=residual_px,
        used=used,
        position_std_m=position_std_m,
        turn_std_deg=turn_std_deg,
    )


def apart(one: FloatArray, other: FloatArray) -> tuple[float, float]:
    """Return how far two (4, 4) transforms are from each other: metres, degrees."""
    turn = Rotation.from_matrix(one[:3, :3].T @ other[:3, :3])
    return float(np.linalg.norm(one[:3, 3] - other[:3, 3])), float(np.degrees(turn.magnitude()))


def _require_enough(views: int) -> None:
    if views < FEWEST_VIEWS:
        raise CalibrationError(
            f"{views} views show enough of the board and fit each other; take at least"
            f" {FEWEST_VIEWS}, better 15"
        )


def _require_turns(poses: _Poses) -> None:
    """Refuse turns that leave the place or the direction of the camera open."""
    _, b = _motions(poses)
    turns = Rotation.from_matrix(b[:, :3, :3]).as_rotvec()
    widest_deg = np.degrees(np.linalg.svd(turns, compute_uv=False) / np.sqrt(len(turns)))
    if widest_deg[0] < LEAST_TURN_DEG:
        raise CalibrationError(
            f"the camera is turned by {widest_deg[0]:.1f}° between views; turn it by 30° and more"
        )
    if widest_deg[1] < LEAST_TURN_DEG:
        raise CalibrationError(
            "the camera is turned about one axis only; tilt it, and roll it, by 30° and more"
        )


def _camera_from_board(view: BoardView) -> FloatArray:
    pinhole = view.intrinsics
    matrix = np.array(
        [[pinhole.fx_px, 0, pinhole.cx_px], [0, pinhole.fy_px, pinhole.cy_px], [0, 0, 1.0]]
    )
    found, turn, shift = cv2.solvePnP(view.corners_in_board, view.pixels, matrix, np.zeros(0))
    if not found:
        raise CalibrationError(f"view {view.index}: the corners found are not those of a board")
    return transform_from(Rotation.from_rotvec(turn[:, 0]).as_matrix(), shift[:, 0])


def _motions(poses: _Poses) -> tuple[FloatArray, FloatArray]:
    """Return A and B of AX = XB for all pairs of views: (P, 4, 4) each."""
    i, j = np.triu_indices(len(poses.base_from_tool0), k=1)
    tool0_from_base = np.array([invert(one) for one in poses.base_from_tool0])
    board_from_camera = np.array([invert(one) for one in poses.camera_from_board])
    a: FloatArray = tool0_from_base[i] @ poses.base_from_tool0[j]
    b: FloatArray = poses.camera_from_board[i] @ board_from_camera[j]
    return a, b


def _park_martin(poses: _Poses) -> FloatArray:
    """Return tool_from_camera X, which fits AX = XB best over all pairs of views."""
    a, b = _motions(poses)
    turn, _ = Rotation.align_vectors(
        Rotation.from_matrix(a[:, :3, :3]).as_rotvec(),
        Rotation.from_matrix(b[:, :3, :3]).as_rotvec(),
    )
    left = (a[:, :3, :3] - np.eye(3)).reshape(-1, 3)
    right = (turn.apply(b[:, :3, 3]) - a[:, :3, 3]).reshape(-1)
    return transform_from(turn.as_matrix(), np.linalg.lstsq(left, right, rcond=None)[0])


def _mean_board(poses: _Poses, tool_from_camera: FloatArray) -> FloatArray:
    boards = poses.base_from_tool0 @ tool_from_camera @ poses.camera_from_board
    turn = Rotation.from_matrix(boards[:, :3, :3]).mean()
    return transform_from(turn.as_matrix(), boards[:, :3, 3].mean(axis=0))


def _residual_px(
    view: BoardView, tool_from_camera: FloatArray, base_from_board: FloatArray
) -> float:
    camera_from_board = invert(view.base_from_tool0 @ tool_from_camera) @ base_from_board
    corners = transform_points(camera_from_board, view.corners_in_board)
    if (corners[:, 2] <= 0).any():
        return np.inf
    away_px = np.linalg.norm(view.intrinsics.project(corners) - view.pixels, axis=1)
    return float(np.sqrt(np.mean(away_px**2)))


def _jackknife(poses: _Poses, tool_from_camera: FloatArray) -> tuple[float, float]:
    """Return the standard deviation of tool_from_camera from results that lack one view each."""
    count = len(poses.base_from_tool0)
    without = [_park_martin(poses.only(np.arange(count) != left_out)) for left_out in range(count)]
    shifts_m = np.array([one[:3, 3] for one in without])
    turns = Rotation.from_matrix([tool_from_camera[:3, :3].T @ one[:3, :3] for one in without])
    position_m, turn_rad = (
        float(np.sqrt((count - 1) * part.var(axis=0).sum()))
        for part in (shifts_m, turns.as_rotvec())
    )
    return position_m, float(np.degrees(turn_rad))
