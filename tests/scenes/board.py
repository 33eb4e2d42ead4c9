"""Pictures of a calibration board, and arms that stand where they are told."""

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from canopy_skel.frame import Intrinsics
from canopy_skel.geometry import invert, transform_from
from drivers.board import Board, drawn
from mock_hw.orchard.path import OAK_D, TOOL_FROM_CAMERA, look_at

BOARD = Board(columns=9, rows=6, square_m=0.03, marker_m=0.022)
BASE_FROM_BOARD = transform_from(
    Rotation.from_euler("xyz", [90, 0, 90], degrees=True).as_matrix(), [0.9, -0.13, 0.2]
)
MIDDLE_M = [0.9, 0.0, 0.29]
_SQUARE_PX = 60


def mounted(rotation_vector, shift_m):
    """A hand-eye transform this far from that of the simulated camera."""
    turn = Rotation.from_rotvec(rotation_vector).as_matrix()
    return TOOL_FROM_CAMERA @ transform_from(turn, shift_m)


def cameras(count, seed=1, rolled=0.7, spread=0.5, distances_m=(0.35, 0.7)):
    """Return `base_from_camera` of cameras before the board, looking at it.

    `spread` is how far they are aside, per metre of distance.
    """
    rng = np.random.default_rng(seed)
    poses = []
    for _ in range(count):
        away = rng.uniform(*distances_m) * np.array([-1, *rng.uniform(-spread, spread, 2)])
        target = MIDDLE_M + rng.uniform(-0.03, 0.03, 3) * (spread > 0)
        roll = Rotation.from_rotvec([0, 0, rng.uniform(-rolled, rolled)]).as_matrix()
        poses.append(look_at(MIDDLE_M + away, target) @ transform_from(roll, np.zeros(3)))
    return poses


def picture(base_from_camera, rng=None, intrinsics: Intrinsics = OAK_D):
    """What a camera sees of the board, before grey."""
    flat = drawn(BOARD, _SQUARE_PX)
    scale = BOARD.square_m / _SQUARE_PX
    middle = (0.5 - _SQUARE_PX / 2) * scale  # of the first pixel; the margin is half a square
    board_from_flat = np.array([[scale, 0, middle], [0, scale, middle], [0, 0, 1]])
    camera_from_board = invert(base_from_camera) @ BASE_FROM_BOARD
    matrix = np.array(
        [
            [intrinsics.fx_px, 0, intrinsics.cx_px],
            [0, intrinsics.fy_px, intrinsics.cy_px],
            [0, 0, 1],
        ]
    )
    warp = matrix @ camera_from_board[:3, [0, 1, 3]] @ board_from_flat
    size = (intrinsics.width_px, intrinsics.height_px)
    seen = cv2.warpPerspective(flat, warp, size, flags=cv2.INTER_AREA, borderValue=127)
    if rng is not None:
        seen = np.clip(seen + rng.normal(0, 3, seen.shape), 0, 255).astype(np.uint8)
    return np.repeat(seen[..., None], 3, axis=2)
