"""What is known of a camera's lens, and whether it can be true."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from canopy_skel.geometry import FloatArray

_R_TOLERANCE = 1e-3
_MEND = "calibrate the camera, or record what its driver publishes"


@dataclass(frozen=True, kw_only=True, eq=False, slots=True)
class Calibration:
    """A camera calibration in the ROS convention.

    k: (3, 3) of the raw image, px. d: distortion coefficients. r: (3, 3) rotates raw into rectified
    camera axes. p: (3, 4) projection of the rectified image, px; p[0, 3] = -fx * baseline in the
    right camera of a pair.
    """

    stamp_ns: int
    frame_id: str
    width_px: int
    height_px: int
    distortion_model: str
    d: FloatArray
    k: FloatArray
    r: FloatArray
    p: FloatArray


def calibration_from_lists(
    *,
    stamp_ns: int,
    frame_id: str,
    size: tuple[int, int],
    model: str,
    d: Iterable[float],
    k: Sequence[float],
    r: Sequence[float],
    p: Sequence[float],
) -> Calibration:
    """Build a calibration from row-major lists; R and P may be missing (empty or all zero).

    R may be rounded: the nearest rotation is taken.

    Raises:
        ValueError: a list has a wrong length or is not finite, K or P has no focal length, or R is
            no rotation.
    """
    d = list(d)
    for name, values, lengths in (("K", k, (9,)), ("R", r, (0, 9)), ("P", p, (0, 12))):
        if len(values) not in lengths or not np.isfinite(values).all():
            raise ValueError(
                f"{name} must be {lengths[-1]} finite numbers, not {_short(values)}; {_MEND}"
            )
    if not np.isfinite(d).all():
        raise ValueError(f"D must be finite numbers, not {_short(d)}; {_MEND}")
    k_matrix = np.array(k, dtype=np.float64).reshape(3, 3)
    p_matrix = np.column_stack([k_matrix, np.zeros(3)])
    if any(p):
        p_matrix = np.array(p, dtype=np.float64).reshape(3, 4)
    for name, matrix in (("K", k_matrix), ("P", p_matrix)):
        if not (matrix[0, 0] > 0 and matrix[1, 1] > 0):
            raise ValueError(
                f"{name} has no focal length (fx = {matrix[0, 0]:g}, fy = {matrix[1, 1]:g});"
                f" {_MEND}"
            )
    return Calibration(
        stamp_ns=stamp_ns,
        frame_id=frame_id,
        width_px=size[0],
        height_px=size[1],
        distortion_model=model,
        d=np.array(d, dtype=np.float64),
        k=k_matrix,
        r=_rotation(r) if any(r) else np.eye(3),
        p=p_matrix,
    )


def _rotation(r: Sequence[float]) -> FloatArray:
    """Return the rotation nearest to nine numbers that are one but for rounding."""
    matrix = np.array(r, dtype=np.float64).reshape(3, 3)
    # Entries are bounded first: the product of huge ones overflows.
    if not (
        np.abs(matrix).max() <= 1 + _R_TOLERANCE
        and np.allclose(matrix @ matrix.T, np.eye(3), rtol=0, atol=_R_TOLERANCE)
        and np.linalg.det(matrix) > 0
    ):
        raise ValueError(f"R is no rotation: {_short(r)}; {_MEND}")
    left, _, right = np.linalg.svd(matrix)
    nearest: FloatArray = left @ right
    return nearest


def _short(values: Sequence[float]) -> str:
    """Write numbers for a message: all of a matrix, the first of a longer list."""
    more = ", …" if len(values) > 12 else ""
    return f"[{', '.join(f'{value:g}' for value in values[:12])}{more}]"
