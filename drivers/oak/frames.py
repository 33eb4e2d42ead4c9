"""From the frames of one exposure, as depthai delivers them, to a picture."""

from collections.abc import Mapping
from dataclasses import dataclass
from datetime import timedelta
from typing import TYPE_CHECKING

import numpy as np

from canopy_skel.frame import Float32Array, Intrinsics, StereoPair, UInt16Array
from canopy_skel.pixels import as_mono, as_rgb
from drivers.protocols import CameraImage

if TYPE_CHECKING:
    import depthai as dai


@dataclass(frozen=True, kw_only=True, eq=False, slots=True)
class Exposure:
    """The frames of one exposure by name: color and depth, or left, right and depth.

    baseline_m: of the stereo cameras, from the calibration of the device.
    """

    frames: "Mapping[str, dai.ImgFrame]"
    baseline_m: float

    @property
    def began_ns(self) -> int:
        """Host time at which no frame was exposed yet.

        A depth frame may not say how long its cameras were exposed: the longest counts for all.
        """
        end = min(frame.getTimestamp() for frame in self.frames.values())
        return _ns(end - max(frame.getExposureTime() for frame in self.frames.values()))

    def image(self) -> CameraImage:
        """Return the picture, stamped with the middle of its exposure.

        Raises:
            ValueError: depth is not aligned, or the device is not calibrated.
        """
        eye = self.frames["color" if "color" in self.frames else "left"]
        # depthai hands out colour as OpenCV does, blue first.
        pixels = np.array(eye.getCvFrame())
        depth_m = _metres(np.asarray(self.frames["depth"].getFrame(), dtype=np.uint16))
        if depth_m.shape != pixels.shape[:2]:
            raise ValueError(
                f"depth is {depth_m.shape[1]}x{depth_m.shape[0]} but colour is {pixels.shape[1]}x"
                f"{pixels.shape[0]}: choose a size the device can align"
            )
        return CameraImage(
            stamp_ns=_ns(eye.getTimestamp() - eye.getExposureTime() / 2),
            color_rgb=as_rgb(pixels if pixels.ndim == 2 else pixels[..., ::-1]),
            intrinsics=intrinsics_of(eye),
            depth_m=depth_m,
            stereo=self._pair() if "left" in self.frames else None,
        )

    def _pair(self) -> StereoPair:
        left, right = self.frames["left"], self.frames["right"]
        return StereoPair(
            left_mono=as_mono(np.array(left.getCvFrame())),
            right_mono=as_mono(np.array(right.getCvFrame())),
            intrinsics=intrinsics_of(left),
            baseline_m=self.baseline_m,
        )


def intrinsics_of(frame: "dai.ImgFrame") -> Intrinsics:
    """Return the pinhole of an undistorted frame: the device scales and crops it with the picture.

    Raises:
        ValueError: the device does not know.
    """
    matrix = np.asarray(frame.getTransformation().getIntrinsicMatrix(), dtype=np.float64)
    width_px, height_px = frame.getWidth(), frame.getHeight()
    (fx, _, cx), (_, fy, cy), _ = matrix.tolist()
    if not (fx > 1 and fy > 1 and 0 < cx < width_px and 0 < cy < height_px):
        raise ValueError(
            f"no plausible intrinsics for {width_px}x{height_px} (fx {fx:.1f}, cx {cx:.1f}): is"
            " the device calibrated?"
        )
    return Intrinsics(
        fx_px=fx, fy_px=fy, cx_px=cx, cy_px=cy, width_px=width_px, height_px=height_px
    )


def _metres(millimetres: UInt16Array) -> Float32Array:
    """Return depth in metres, NaN = no return; nothing near enough to see is no error here."""
    return np.where(millimetres > 0, millimetres * np.float32(1e-3), np.float32(np.nan))


def _ns(since_start: timedelta) -> int:
    return since_start // timedelta(microseconds=1) * 1000
