"""A view: what one exposure saw, with the pose it was taken from. The input of the method."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from canopy_skel.errors import ViewError
from canopy_skel.geometry import FloatArray, is_rigid

UInt8Array = NDArray[np.uint8]
UInt16Array = NDArray[np.uint16]
Float32Array = NDArray[np.float32]

LONGEST_SIDE = 10.0
"""Of a picture, in focal lengths: a field of view of 157 degrees."""
LONGEST_FOCUS = 100.0
"""Focal length in longer sides of the picture: a field of view of half a degree."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Intrinsics:
    """A pinhole camera without distortion, OpenCV optical frame (+z forward, +x right, +y down)."""

    fx_px: float
    fy_px: float
    cx_px: float
    cy_px: float
    width_px: int
    height_px: int

    def flaw(self) -> str | None:
        """Say why no pinhole camera is like that; None if one can be.

        Points of a picture lifted by such numbers lie where no arithmetic reaches.
        """
        f, c = (self.fx_px, self.fy_px), (self.cx_px, self.cy_px)
        size = (self.width_px, self.height_px)
        side = max(size)
        if not all(side / LONGEST_SIDE <= one <= side * LONGEST_FOCUS for one in f):
            return (
                f"fx = {f[0]:g}, fy = {f[1]:g} px is no focal length of a picture of"
                f" {size[0]}x{size[1]}: {side / LONGEST_SIDE:g} to {side * LONGEST_FOCUS:g} is"
            )
        if not all(-side <= one <= most + side for one, most in zip(c, size, strict=True)):
            return (
                f"cx = {c[0]:g}, cy = {c[1]:g} px is more than a picture of {size[0]}x{size[1]}"
                " outside of it"
            )
        return None

    def back_project(self, u_px: FloatArray, v_px: FloatArray, depth_m: FloatArray) -> FloatArray:
        """Return (N, 3) points in the camera frame for N pixel centres and their z depth."""
        x = (u_px - self.cx_px) / self.fx_px * depth_m
        y = (v_px - self.cy_px) / self.fy_px * depth_m
        return np.stack([x, y, depth_m], axis=-1)

    def project(self, points_in_camera: FloatArray) -> FloatArray:
        """Return (N, 2) pixel coordinates (u, v) of (N, 3) points with z > 0."""
        z = points_in_camera[:, 2]
        u = self.fx_px * points_in_camera[:, 0] / z + self.cx_px
        v = self.fy_px * points_in_camera[:, 1] / z + self.cy_px
        return np.stack([u, v], axis=-1)


@dataclass(frozen=True, kw_only=True, eq=False, slots=True)
class StereoPair:
    """A rectified pair; the left camera is the colour camera of the view.

    left_mono, right_mono: (H, W) uint8. baseline_m: distance between the optical centres.
    """

    left_mono: UInt8Array
    right_mono: UInt8Array
    intrinsics: Intrinsics
    baseline_m: float


@dataclass(frozen=True, kw_only=True, eq=False, slots=True)
class View:
    """One exposure: pose and pictures paired at the source.

    index: place in the scan (0, 1, …). stamp_ns: exposure time, int nanoseconds.
    color_rgb: (H, W, 3) uint8, undistorted. depth_m: (H, W) float32 aligned to colour,
    NaN = no return; None while only the stereo pair is known. matched: the depth was matched here
    from the stereo pair, not measured by the camera.
    base_from_camera: (4, 4), maps points of the camera's optical frame into base.
    instances: (H, W) uint16, 0 = none, i = branch instance i; scores: confidence of instance
    i at scores[i - 1]; both None where nobody segmented the view.

    Raises:
        ViewError: shapes disagree, no camera has these intrinsics, or the pose is not a rigid
            transform.
    """

    index: int
    stamp_ns: int
    color_rgb: UInt8Array
    intrinsics: Intrinsics
    base_from_camera: FloatArray
    depth_m: Float32Array | None = None
    stereo: StereoPair | None = None
    matched: bool = False
    instances: UInt16Array | None = None
    scores: tuple[float, ...] | None = None

    def __post_init__(self) -> None:
        """Check the parts against each other once; trusted afterwards."""
        for lens in (self.intrinsics, *([self.stereo.intrinsics] if self.stereo else [])):
            if flaw := lens.flaw():
                raise ViewError(
                    f"view {self.index}: {flaw}; give the calibration of the picture, in its pixels"
                )
        size = (self.intrinsics.height_px, self.intrinsics.width_px)
        for name, image in (
            ("colour", self.color_rgb),
            ("depth", self.depth_m),
            ("instances", self.instances),
        ):
            if image is not None and image.shape[:2] != size:
                raise ViewError(
                    f"view {self.index}: {name} is {image.shape[1]}x{image.shape[0]} but the colour"
                    f" calibration says {size[1]}x{size[0]}; align {name} to the colour camera"
                )
        for number, score in enumerate(self.scores or (), start=1):
            if not 0.0 <= score <= 1.0:
                raise ViewError(
                    f"view {self.index}: the score of instance {number} is {score}; scores are"
                    " probabilities, 0 to 1"
                )
        if not is_rigid(self.base_from_camera):
            raise ViewError(
                f"view {self.index}: base_from_camera is not a rigid transform (NaN or degenerate"
                " rotation); check the arm pose and the hand-eye calibration on /tf"
            )
        for array in (self.color_rgb, self.depth_m, self.instances):
            if array is not None:
                array.setflags(write=False)
        self.base_from_camera.setflags(write=False)
