"""Three sticks of wood in front of a camera, small and exact enough to reason about."""

import numpy as np

from canopy_skel.frame import Intrinsics, View

LENS = Intrinsics(fx_px=300, fy_px=300, cx_px=160, cy_px=120, width_px=320, height_px=240)
LOOKING_ALONG_X = np.array([[0, 0, 1.0, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
# A trunk, a branch that leaves it, and a twig ahead of the branch behind a gap of 6 cm.
WOOD = [
    ((1.0, 0.0, -0.3), (1.0, 0.0, 0.3), 0.015),
    ((1.0, 0.02, 0.0), (1.0, 0.18, 0.08), 0.008),
    ((1.0, 0.24, 0.11), (1.0, 0.36, 0.17), 0.008),
]


def view_from(index, y=0.0, z=0.0, seed=0, **changes):
    """A picture of the wood's front surface, seen from the base origin moved to (0, y, z)."""
    pose = LOOKING_ALONG_X.copy()
    pose[:3, 3] = (0, y, z)
    depth_m = np.full((240, 320), np.inf)
    instances = np.zeros((240, 320), np.uint16)
    for number, (start, end, radius) in enumerate(WOOD, start=1):
        start, end = np.array(start), np.array(end)
        for along in np.linspace(0, 1, 500):
            axis = (end - start) / np.linalg.norm(end - start)
            centre = start + along * (end - start) - pose[:3, 3]
            sideways = np.cross([1, 0, 0], axis)
            for across in np.linspace(-1, 1, 25):
                p = centre + across * radius * sideways
                p[0] -= radius * np.sqrt(1 - across**2)
                u, v = round(160 - 300 * p[1] / p[0]), round(120 - 300 * p[2] / p[0])
                if 0 <= u < 320 and 0 <= v < 240 and p[0] < depth_m[v, u]:
                    depth_m[v, u], instances[v, u] = p[0], number
    noise = np.random.default_rng(seed + index).normal(0, 0.002, depth_m.shape)
    depth_m = np.where(np.isfinite(depth_m), depth_m + noise, np.nan).astype(np.float32)
    parts = {
        "index": index,
        "stamp_ns": index,
        "color_rgb": np.zeros((240, 320, 3), np.uint8),
        "intrinsics": LENS,
        "base_from_camera": pose,
        "depth_m": depth_m,
        "instances": instances,
        "scores": (0.9, 0.9, 0.9),
    }
    return View(**(parts | changes))
