"""A ChArUco board: a chessboard with markers in its white squares, so that half of it will do."""

from dataclasses import dataclass
from typing import cast

import cv2
import numpy as np
from numpy.typing import NDArray

from canopy_skel.errors import UsageError
from canopy_skel.frame import UInt8Array
from canopy_skel.geometry import FloatArray
from drivers.hand_eye import FEWEST_CORNERS

Int32Array = NDArray[np.int32]

DICTIONARIES = tuple(
    f"{bits}X{bits}_{size}" for bits in (4, 5, 6, 7) for size in (50, 100, 250, 1000)
)
_MOST_SQUARES = 40
_MARGIN_SQUARES = 0.5


@dataclass(frozen=True, kw_only=True, slots=True)
class Board:
    """What a board is: squares along x and y, the sides of squares and of markers, which markers.

    Raises:
        UsageError: there can be no such board.
    """

    columns: int
    rows: int
    square_m: float
    marker_m: float
    dictionary: str = "5X5_100"

    def __post_init__(self) -> None:
        """Check the numbers once; trusted afterwards."""
        if not (2 < self.columns <= _MOST_SQUARES and 2 < self.rows <= _MOST_SQUARES):
            raise UsageError(
                f"a board of {self.columns}x{self.rows} squares: give 3 to {_MOST_SQUARES} each"
            )
        corners = (self.columns - 1) * (self.rows - 1)
        if corners < FEWEST_CORNERS:
            raise UsageError(
                f"a board of {self.columns}x{self.rows} squares has {corners} inner corners:"
                f" {FEWEST_CORNERS} are needed"
            )
        if not 0 < self.marker_m < self.square_m < 1:
            raise UsageError(
                f"squares of {self.square_m} m with markers of {self.marker_m} m: measure both in"
                " metres; markers are smaller"
            )
        if self.dictionary not in DICTIONARIES:
            known = ", ".join(DICTIONARIES)
            raise UsageError(f"unknown dictionary {self.dictionary!r}; choose one of {known}")
        held = int(self.dictionary.split("_")[1])
        if self.columns * self.rows // 2 > held:
            raise UsageError(
                f"{self.columns}x{self.rows} squares need more than the {held} markers of"
                f" {self.dictionary}; choose a larger dictionary"
            )


class CornerFinder:
    """Finds the inner corners of a board in pictures."""

    def __init__(self, board: Board) -> None:
        self._board = _opencv(board)
        self._corners = np.asarray(self._board.getChessboardCorners(), dtype=np.float64)
        self._detector = cv2.aruco.CharucoDetector(self._board)

    def find(self, color_rgb: UInt8Array) -> tuple[FloatArray, FloatArray]:
        """Return the corners in a (H, W, 3) picture: (N, 3) metres in the board, (N, 2) pixels."""
        grey = cv2.cvtColor(color_rgb, cv2.COLOR_RGB2GRAY)
        pixels, ids, _, _ = self._detector.detectBoard(grey)
        found = cast("Int32Array | None", ids)  # OpenCV's types leave out that it finds nothing
        if found is None:
            return np.empty((0, 3)), np.empty((0, 2))
        return self._corners[found.ravel()], np.asarray(pixels, dtype=np.float64).reshape(-1, 2)


def drawn(board: Board, pixels_per_square: int = 120) -> UInt8Array:
    """Return a picture of the board to print, (H, W) grey, with a white margin."""
    margin = round(_MARGIN_SQUARES * pixels_per_square)
    size = (
        board.columns * pixels_per_square + 2 * margin,
        board.rows * pixels_per_square + 2 * margin,
    )
    picture: UInt8Array = np.asarray(_opencv(board).generateImage(size, marginSize=margin))
    return picture


def _opencv(board: Board) -> cv2.aruco.CharucoBoard:
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{board.dictionary}"))
    size = (board.columns, board.rows)
    return cv2.aruco.CharucoBoard(size, board.square_m, board.marker_m, dictionary)
