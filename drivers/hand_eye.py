"""Hand-eye calibration: where the camera sits on the flange, from views of a board at rest.

The solution is that of Park and Martin ("Robot sensor calibration: solving AX = XB on the
Euclidean group", IEEE Transactions on Robotics and Automation, 1994), over all pairs of views.
Moving it until the corners' pixels fit best makes it worse: errors of the arm's poses, not of the
pixels, are what differs between views, and pixels hardly tell a tilt from a shift.

A view counts by how certain its board pose is: the tilt of a few corners is known far worse than
that of a whole board, and would spoil what the others tell.

The size of the board is one more unknown beside the translation: a board said 1 % too large puts
the camera 5 mm wrong at half a metre, and views at one distance fit as well as before.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from canopy_skel.errors import CanopyError
from canopy_skel.frame import Intrinsics
from canopy_skel.geometry import (
    BoolArray,
    FloatArray,
    IntArray,
    invert,
    transform_from,
    transform_points,
)

FEWEST_VIEWS = 6
FEWEST_CORNERS = 6
LEAST_TURN_DEG = 10.0
FITTING_PX = 2.0
"""A view with a smaller residual fits the others; if most views have larger ones, none does."""
_FITTING_MEDIANS = 4.0
_SUBSETS, _SUBSET_VIEWS, _MOST_REFITS = 100, 4, 10
_CORNER_STD_PX, _ARM_STD_M, _ARM_STD_RAD = 0.2, 1e-4, 2e-4
"""How wrong, on each axis, corners are found and flanges stand; only their ratio matters."""


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

    tool_from_camera, base_from_board: (4, 4). scale: how large the board is by the arm's motions,
    1 as said. residual_px: (V,) of each view, how far the board's corners are from where they
    should be (root mean square), those it does not show by where the others place them.
    used: (V,) which views it is made of; the others do not fit these. position_std_m,
    turn_std_deg, scale_std: how uncertain tool_from_camera and scale are, by leaving out one view
    after the other (jackknife); errors that all views share are not in it.
    """

    tool_from_camera: FloatArray
    base_from_board: FloatArray
    scale: float
    residual_px: FloatArray
    used: BoolArray
    position_std_m: float
    turn_std_deg: float
    scale_std: float

    @property
    def middle_px(self) -> float:
        """The residual that more than half of all views keep, used or not."""
        return _middle(self.residual_px)


@dataclass(frozen=True, eq=False, slots=True)
class _Poses:
    """base_from_tool0, camera_from_board: (V, 4, 4). variances: (V, 2), of turn and shift."""

    base_from_tool0: FloatArray
    camera_from_board: FloatArray
    variances: FloatArray

    def only(self, chosen: BoolArray | IntArray) -> "_Poses":
        return _Poses(
            self.base_from_tool0[chosen], self.camera_from_board[chosen], self.variances[chosen]
        )


@dataclass(frozen=True, eq=False, slots=True)
class _Fit:
    """tool_from_camera, base_from_board: (4, 4). scale: of the board, 1 as said."""

    tool_from_camera: FloatArray
    base_from_board: FloatArray
    scale: float

    def residuals_px(self, views: Sequence[BoardView]) -> FloatArray:
        return np.array([self._residual_px(view) for view in views])

    def _residual_px(self, view: BoardView) -> float:
        base_from_camera = view.base_from_tool0 @ self.tool_from_camera
        camera_from_board = invert(base_from_camera) @ self.base_from_board
        corners = transform_points(camera_from_board, self.scale * view.corners_in_board)
        if (corners[:, 2] <= 0).any():
            return np.inf
        away_px = np.linalg.norm(view.intrinsics.project(corners) - view.pixels, axis=1)
        return float(np.sqrt(np.mean(away_px**2)))


def calibrate(views: Sequence[BoardView]) -> HandEye:
    """Return where the camera is, from views with at least FEWEST_CORNERS corners each.

    Up to a third of the views may be wrong; they are left out.

    Raises:
        CalibrationError: too few views, or the camera was hardly turned, or about one axis only.
    """
    _require_enough(len(views))
    board = np.unique(np.concatenate([view.corners_in_board for view in views]), axis=0)
    camera_from_board = np.array([_camera_from_board(view) for view in views])
    poses = _Poses(
        np.array([view.base_from_tool0 for view in views]),
        camera_from_board,
        np.array(
            [
                _variances(view, pose, board.mean(axis=0))
                for view, pose in zip(views, camera_from_board, strict=True)
            ]
        ),
    )
    _require_turns(poses)
    whole = [
        _completed(view, pose, board)
        for view, pose in zip(views, poses.camera_from_board, strict=True)
    ]
    residual_px = _consensus_px(whole, poses)
    used = np.zeros(len(views), dtype=np.bool_)
    for _ in range(_MOST_REFITS):
        fitting = _fitting(residual_px)
        if (fitting == used).all():
            break
        used = fitting
        _require_enough(int(used.sum()))
        _require_turns(poses.only(used))
        fit = _fit(poses.only(used))
        residual_px = fit.residuals_px(whole)
    position_std_m, turn_std_deg, scale_std = _jackknife(poses.only(used), fit)
    return HandEye(
        tool_from_camera=fit.tool_from_camera,
        base_from_board=fit.base_from_board,
        scale=fit.scale,
        residual_px=residual_px,
        used=used,
        position_std_m=position_std_m,
        turn_std_deg=turn_std_deg,
        scale_std=scale_std,
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
    matrix = _matrix(view.intrinsics)
    found, turn, shift = cv2.solvePnP(view.corners_in_board, view.pixels, matrix, np.zeros(0))
    if not found:
        raise CalibrationError(f"view {view.index}: the corners found are not those of a board")
    return transform_from(Rotation.from_rotvec(turn[:, 0]).as_matrix(), shift[:, 0])


def _matrix(pinhole: Intrinsics) -> FloatArray:
    return np.array(
        [[pinhole.fx_px, 0, pinhole.cx_px], [0, pinhole.fy_px, pinhole.cy_px], [0, 0, 1.0]]
    )


def _variances(view: BoardView, camera_from_board: FloatArray, middle: FloatArray) -> FloatArray:
    """Return how uncertain turn (rad²) and shift (m²) of a view's motions are, by its corners.

    middle: (3,) of the board. To begin with, the pose is known to 1 rad and 1 m: corners in a row
    tell no tilt about it.
    """
    turned = (view.corners_in_board - middle) @ camera_from_board[:3, :3].T
    middle_in_camera = transform_points(camera_from_board, middle[None])[0]
    _, slopes = cv2.projectPoints(
        turned, np.zeros(3), middle_in_camera, _matrix(view.intrinsics), np.zeros(0)
    )
    known = slopes[:, :6].T @ slopes[:, :6] / _CORNER_STD_PX**2 + np.eye(6)
    of_pose = np.diag(np.linalg.inv(known))
    turn = of_pose[:3].sum() + 3 * _ARM_STD_RAD**2
    shift = of_pose[3:].sum() + 3 * _ARM_STD_M**2
    return np.array([turn, shift + turn * (middle_in_camera**2).sum()])


def _completed(view: BoardView, camera_from_board: FloatArray, board: FloatArray) -> BoardView:
    """Return the view with the rest of the board, (B, 3), where its own pose places it.

    The few corners of a view can be where they should be while its pose is far from right.
    """
    seen = (board[:, None] == view.corners_in_board).all(axis=2).any(axis=1)
    rest = board[~seen]
    rest_px = view.intrinsics.project(transform_points(camera_from_board, rest))
    return replace(
        view,
        corners_in_board=np.concatenate([view.corners_in_board, rest]),
        pixels=np.concatenate([view.pixels, rest_px]),
    )


def _motions(poses: _Poses) -> tuple[FloatArray, FloatArray]:
    """Return A and B of AX = XB for all pairs of views: (P, 4, 4) each."""
    i, j = np.triu_indices(len(poses.base_from_tool0), k=1)
    tool0_from_base = np.array([invert(one) for one in poses.base_from_tool0])
    board_from_camera = np.array([invert(one) for one in poses.camera_from_board])
    a: FloatArray = tool0_from_base[i] @ poses.base_from_tool0[j]
    b: FloatArray = poses.camera_from_board[i] @ board_from_camera[j]
    return a, b


def _weights(poses: _Poses) -> FloatArray:
    """Return how much each pair of views counts, (P, 2), for turn and shift; 1 on average."""
    i, j = np.triu_indices(len(poses.variances), k=1)
    weights = 1 / (poses.variances[i] + poses.variances[j])
    weighed: FloatArray = weights / weights.mean(axis=0)
    return weighed


def _consensus_px(views: Sequence[BoardView], poses: _Poses) -> FloatArray:
    """Return the (V,) residuals of the few views, chosen by lot, that most others agree with.

    A fit to all would be drawn to views that are wrong together, as after the board was moved,
    until none of them stands out.
    """
    rng = np.random.default_rng(0)
    lots = (rng.choice(len(views), _SUBSET_VIEWS, replace=False) for _ in range(_SUBSETS))
    return min((_fit(poses.only(lot)).residuals_px(views) for lot in lots), key=_middle)


def _middle(residual_px: FloatArray) -> float:
    """Return the upper median: half of the views agreeing is not enough."""
    return float(np.sort(residual_px)[len(residual_px) // 2])


def _fitting(residual_px: FloatArray) -> BoolArray:
    """Return which of (V,) views fit the others: all, if most do not."""
    middle_px = _middle(residual_px)
    if middle_px > FITTING_PX:
        return np.ones(len(residual_px), dtype=np.bool_)
    fitting: BoolArray = residual_px <= max(FITTING_PX, _FITTING_MEDIANS * middle_px)
    return fitting


def _fit(poses: _Poses) -> _Fit:
    """Return what fits AX = XB best over all pairs of views, and where the board is then."""
    a, b = _motions(poses)
    turn_weights, shift_weights = _weights(poses).T
    turn = _park_martin_turn(a[:, :3, :3], b[:, :3, :3], turn_weights)
    # (R_A - 1) t_X = scale R_X t_B - t_A; solved for scale - 1, which stays 0 if nothing tells it
    board_m = b[:, :3, 3] @ turn.T
    left = np.concatenate([a[:, :3, :3] - np.eye(3), -board_m[..., None]], axis=2).reshape(-1, 4)
    right = (board_m - a[:, :3, 3]).reshape(-1)
    by = np.sqrt(shift_weights).repeat(3)
    found = np.linalg.lstsq(left * by[:, None], right * by, rcond=None)[0]
    tool_from_camera, scale = transform_from(turn, found[:3]), 1 + float(found[3])
    return _Fit(tool_from_camera, _mean_board(poses, tool_from_camera, scale), scale)


def _park_martin_turn(a: FloatArray, b: FloatArray, weights: FloatArray) -> FloatArray:
    """Return the (3, 3) turn that takes the axes of the (P, 3, 3) turns b to those of a best."""
    axes_a, axes_b = (Rotation.from_matrix(turns).as_rotvec() for turns in (a, b))
    u, _, vt = np.linalg.svd((weights[:, None] * axes_a).T @ axes_b)
    turn: FloatArray = u @ np.diag([1, 1, np.sign(np.linalg.det(u @ vt))]) @ vt
    return turn


def _mean_board(poses: _Poses, tool_from_camera: FloatArray, scale: float) -> FloatArray:
    camera_from_board = poses.camera_from_board.copy()
    camera_from_board[:, :3, 3] *= scale
    boards = poses.base_from_tool0 @ tool_from_camera @ camera_from_board
    turn_weights, shift_weights = 1 / poses.variances.T
    turn = Rotation.from_matrix(boards[:, :3, :3]).mean(weights=turn_weights)
    place_m = np.average(boards[:, :3, 3], axis=0, weights=shift_weights)
    return transform_from(turn.as_matrix(), place_m)


def _jackknife(poses: _Poses, fit: _Fit) -> tuple[float, float, float]:
    """Return the standard deviations of place (m), turn (degrees) and scale of a fit.

    They come from fits that lack one view each.
    """
    count = len(poses.base_from_tool0)
    without = [_fit(poses.only(np.arange(count) != left_out)) for left_out in range(count)]
    shifts_m = np.array([one.tool_from_camera[:3, 3] for one in without])
    back = fit.tool_from_camera[:3, :3].T
    turns = Rotation.from_matrix([back @ one.tool_from_camera[:3, :3] for one in without])
    scales = np.array([[one.scale] for one in without])
    position_m, turn_rad, scale = (
        float(np.sqrt((count - 1) * part.var(axis=0).sum()))
        for part in (shifts_m, turns.as_rotvec(), scales)
    )
    return position_m, float(np.degrees(turn_rad)), scale
