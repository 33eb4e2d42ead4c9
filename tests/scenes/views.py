"""Views made of a picture alone."""

import numpy as np

from canopy_skel.frame import Intrinsics, View


def view_of(color_rgb, **fields):
    height, width = color_rgb.shape[:2]
    lens = Intrinsics(
        fx_px=0.7 * width,
        fy_px=0.7 * width,
        cx_px=width / 2,
        cy_px=height / 2,
        width_px=width,
        height_px=height,
    )
    return View(
        index=3,
        stamp_ns=0,
        color_rgb=color_rgb,
        intrinsics=lens,
        base_from_camera=np.eye(4),
        **fields,
    )
