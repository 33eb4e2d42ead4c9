"""From pictures as a lens makes them to pictures of a pinhole camera."""

from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np

from canopy_skel.calibration import Calibration
from canopy_skel.frame import Intrinsics
from canopy_skel.geometry import FloatArray
from canopy_skel.pixels import Pixels

_FISHEYE = ("kannala_brandt", "equidistant")
_POLYNOMIAL = ("plumb_bob", "rational_polynomial")


@dataclass(frozen=True, kw_only=True, eq=False, slots=True)
class Rectification:
    """How to make the pinhole picture of a raw one.

    camera_from_pinhole: (3, 3) rotation from the pinhole camera's axes into the raw camera's.
    baseline_m: distance to the first camera of a rectified pair, 0 for a camera alone.
    map_u, map_v: (H, W) where each pixel comes from; None where the picture is a pinhole's already.
    """

    intrinsics: Intrinsics
    camera_from_pinhole: FloatArray
    baseline_m: float
    map_u: Pixels | None = None
    map_v: Pixels | None = None

    def apply(self, pixels: Pixels, kind: Literal["colour", "depth", "labels"]) -> Pixels:
        """Return the pinhole picture: colour interpolated, depth and labels by nearest pixel.

        Raises:
            ValueError: the picture has another size than the calibration.
        """
        width_px, height_px = self.intrinsics.width_px, self.intrinsics.height_px
        if pixels.shape[:2] != (height_px, width_px):
            raise ValueError(
                f"is {pixels.shape[1]}x{pixels.shape[0]} but the calibration says"
                f" {width_px}x{height_px}; record both for the same picture, aligned to colour"
            )
        if self.map_u is None or self.map_v is None:
            return pixels
        how = cv2.INTER_LINEAR if kind == "colour" else cv2.INTER_NEAREST
        outside = float("nan") if kind == "depth" else 0
        return cv2.remap(
            pixels, self.map_u, self.map_v, how, borderMode=cv2.BORDER_CONSTANT, borderValue=outside
        )


def rectification(calibration: Calibration, rectified: bool) -> Rectification:
    """Return how to rectify the pictures of a camera, as ROS image_proc does it: by R and P.

    A camera without distortion and rotation keeps its pixels and its K.

    Args:
        calibration: of the raw camera.
        rectified: the pictures have been rectified already; P describes them.

    Raises:
        ValueError: the distortion model is unknown.
    """
    c = calibration
    turned = not np.allclose(c.r, np.eye(3), atol=1e-9)
    raw_is_pinhole = not c.d.any() and not turned
    matrix = c.k if raw_is_pinhole and not rectified else c.p[:, :3]
    baseline_m = -float(c.p[0, 3]) / float(c.p[0, 0])
    intrinsics = Intrinsics(
        fx_px=float(matrix[0, 0]),
        fy_px=float(matrix[1, 1]),
        cx_px=float(matrix[0, 2]),
        cy_px=float(matrix[1, 2]),
        width_px=c.width_px,
        height_px=c.height_px,
    )
    if rectified or raw_is_pinhole:
        return Rectification(
            intrinsics=intrinsics, camera_from_pinhole=np.eye(3), baseline_m=baseline_m
        )
    map_u, map_v = _maps(c, matrix)
    return Rectification(
        intrinsics=intrinsics,
        camera_from_pinhole=c.r.T,
        baseline_m=baseline_m,
        map_u=map_u,
        map_v=map_v,
    )


def _maps(calibration: Calibration, matrix: FloatArray) -> tuple[Pixels, Pixels]:
    c = calibration
    size = (c.width_px, c.height_px)
    if c.distortion_model in _FISHEYE and len(c.d) == 4:
        return cv2.fisheye.initUndistortRectifyMap(c.k, c.d, c.r, matrix, size, cv2.CV_32FC1)
    if not c.d.any() or (c.distortion_model in _POLYNOMIAL and len(c.d) in (4, 5, 8)):
        return cv2.initUndistortRectifyMap(c.k, c.d, c.r, matrix, size, cv2.CV_32FC1)
    raise ValueError(
        f"distortion model {c.distortion_model!r} with {len(c.d)} coefficients is not one of"
        f" {', '.join((*_POLYNOMIAL, *_FISHEYE))}; undistort the pictures before recording"
    )
