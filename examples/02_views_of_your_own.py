"""Pictures and poses of your own, and a segmenter of your own: no recording, no robot."""

from collections.abc import Sequence

import numpy as np
from scipy.ndimage import find_objects, label

from canopy_skel.frame import Intrinsics, View
from canopy_skel.geometry import transform_from
from canopy_skel.pipeline import MethodConfig, Skeletonizer
from canopy_skel.segment import BranchMask

CAMERA = Intrinsics(fx_px=600, fy_px=600, cx_px=319.5, cy_px=239.5, width_px=640, height_px=480)
# Columns are the camera's axes in base: right is -y, down is -z, forward is x.
LOOKING_ALONG_X = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
POLE_RADIUS_M = 0.015
BARK, LEAF, SKY = (110, 80, 50), (60, 140, 40), (170, 200, 235)


class BrownIsWood:
    """A segmenter is anything that returns branch masks with a confidence."""

    def segment(self, view: View) -> Sequence[BranchMask]:
        """Return each connected patch that is more red than green."""
        red, green, _ = np.moveaxis(view.color_rgb, 2, 0)
        patches, _ = label(red > green)
        return [
            BranchMask(
                instance=number,
                left_px=columns.start,
                top_px=rows.start,
                mask=patches[rows, columns] == number,
                confidence=0.9,
            )
            for number, (rows, columns) in enumerate(find_objects(patches), start=1)
        ]


def photograph(index: int, y_m: float) -> View:
    """Draw a pole 1 m away, seen from `y_m` to its left; leaves before it hide its middle."""
    v_px, u_px = np.indices((CAMERA.height_px, CAMERA.width_px))
    beside_m = (u_px - CAMERA.cx_px) / CAMERA.fx_px - y_m
    above_px = CAMERA.cy_px - v_px
    leaves = np.abs(above_px) < 50
    pole = (np.abs(beside_m) < POLE_RADIUS_M) & (np.abs(above_px) < 180) & ~leaves
    front_m = 1.0 - np.sqrt(np.clip(POLE_RADIUS_M**2 - beside_m**2, 0.0, None))
    return View(
        index=index,
        stamp_ns=index * 1_000_000_000,
        color_rgb=np.select(
            [leaves[..., None], pole[..., None]], np.array([LEAF, BARK]), np.array(SKY)
        ).astype(np.uint8),
        depth_m=np.select([leaves, pole], [0.8, front_m], np.nan).astype(np.float32),
        intrinsics=CAMERA,
        base_from_camera=transform_from(LOOKING_ALONG_X, [0.0, y_m, 0.0]),
    )


def main() -> None:
    """Look at a pole from three sides and read what is known of each vertex."""
    skeletonizer = Skeletonizer(BrownIsWood(), MethodConfig())
    for index, y_m in enumerate((-0.1, 0.0, 0.1)):
        skeletonizer.add_view(photograph(index, y_m))

    graph = skeletonizer.skeleton().graph
    for height_m in np.arange(-0.25, 0.26, 0.05):
        nearest = np.abs(graph.vertices_in_base[:, 2] - height_m).argmin()
        x_m, y_m, z_m = graph.vertices_in_base[nearest]
        print(
            f"({x_m:.3f}, {y_m:+.3f}, {z_m:+.3f}) m:"
            f" {'predicted' if graph.occluded[nearest] else 'observed'},"
            f" radius {1000 * graph.radius_m[nearest]:.0f} mm,"
            f" confidence {graph.confidence[nearest]:.2f}"
        )


if __name__ == "__main__":
    main()
