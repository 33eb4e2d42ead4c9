"""Draw a scene: depth, labels and a photograph-like picture."""

from dataclasses import dataclass

import cv2
import numpy as np

from canopy_skel.frame import Float32Array, Intrinsics, UInt8Array
from canopy_skel.geometry import FloatArray, invert, transform_points
from mock_hw.orchard.kernels import raster, shade
from mock_hw.orchard.mesh import Int32Array, Kind, Mesh
from mock_hw.orchard.scene import Scene
from mock_hw.orchard.surroundings import ROW_PITCH_M
from mock_hw.orchard.tree import GROUND_Z_M, TRUNK_X_M

NEAR_M = 0.05


@dataclass(frozen=True, kw_only=True, eq=False, slots=True)
class Picture:
    """What the z-buffer holds.

    depth_m: (H, W) z depth of the nearest surface, inf in the sky. triangle: (H, W) its number
    in the mesh, -1 on ground and sky. kind: (H, W) of `Kind`. vertex: (H, W) skeleton vertex of
    the wood seen, -1 = none. screen: (P, 3) the projected points of the mesh.
    """

    depth_m: FloatArray
    triangle: Int32Array
    kind: UInt8Array
    vertex: Int32Array
    screen: FloatArray


def project(mesh: Mesh, base_from_camera: FloatArray, intrinsics: Intrinsics) -> FloatArray:
    """Return (P, 3) u, v and 1/z of the points; all zero for points nearer than `NEAR_M`."""
    points = transform_points(invert(base_from_camera), mesh.points)
    behind = points[:, 2] < NEAR_M
    points[behind, 2] = 1.0
    inverse = 1.0 / points[:, 2]
    screen = np.empty_like(points)
    screen[:, 0] = intrinsics.fx_px * points[:, 0] * inverse + intrinsics.cx_px
    screen[:, 1] = intrinsics.fy_px * points[:, 1] * inverse + intrinsics.cy_px
    screen[:, 2] = inverse
    screen[behind] = 0.0
    return screen


def ground_inverse_depth(base_from_camera: FloatArray, intrinsics: Intrinsics) -> FloatArray:
    """Return (H, W) 1/z of the ground plane, 0 above the horizon."""
    u = np.arange(intrinsics.width_px) - intrinsics.cx_px
    v = np.arange(intrinsics.height_px) - intrinsics.cy_px
    down = base_from_camera[2, :3]
    slope = (
        down[2] + down[0] * u[None, :] / intrinsics.fx_px + down[1] * v[:, None] / intrinsics.fy_px
    )
    inverse = slope / (GROUND_Z_M - base_from_camera[2, 3])
    return np.asarray(np.maximum(inverse, 0.0))


def draw(mesh: Mesh, base_from_camera: FloatArray, intrinsics: Intrinsics) -> Picture:
    """Draw depth and labels of a mesh above the ground."""
    screen = project(mesh, base_from_camera, intrinsics)
    inverse = ground_inverse_depth(base_from_camera, intrinsics)
    triangle = np.full(inverse.shape, -1, dtype=np.int32)
    raster.draw(screen, mesh.triangles, inverse, triangle)
    with np.errstate(divide="ignore"):
        depth = 1.0 / inverse
    hit = triangle >= 0
    kind = np.where(hit, mesh.kind[triangle], np.where(inverse > 0, Kind.GROUND, Kind.SKY))
    return Picture(
        depth_m=depth,
        triangle=triangle,
        kind=kind.astype(np.uint8),
        vertex=np.where(hit, mesh.vertex[triangle], -1).astype(np.int32),
        screen=screen,
    )


def radiance(
    scene: Scene, picture: Picture, base_from_camera: FloatArray, intrinsics: Intrinsics
) -> Float32Array:
    """Return the (H, W, 3) linear light that reaches the lens."""
    light, mesh = scene.light, scene.mesh
    fine = _doubled(intrinsics)
    fine_screen = picture.screen * [2.0, 2.0, 1.0] + [0.5, 0.5, 0.0]
    fine_inverse = ground_inverse_depth(base_from_camera, fine)
    fine_triangle = np.full(fine_inverse.shape, -1, dtype=np.int32)
    raster.draw(fine_screen, mesh.triangles, fine_inverse, fine_triangle)
    furrow = scene.tree.species.colours.furrow
    air = [furrow, light.cloud, light.haze_m, light.flash, TRUNK_X_M, ROW_PITCH_M]
    pinhole = [intrinsics.fx_px, intrinsics.fy_px, intrinsics.cx_px, intrinsics.cy_px]
    out = np.empty((*picture.depth_m.shape, 3), dtype=np.float32)
    shade.shade(
        shade.Surfaces(
            screen=picture.screen,
            triangles=mesh.triangles,
            normals=mesh.normals,
            coordinates=mesh.texture,
            kind=mesh.kind,
            tone=mesh.tone,
            radius=scene.radius_m,
        ),
        shade.Lights(
            sun=light.sun_direction(),
            sun_map_from_base=scene.sun_map.map_from_base,
            sun_map=scene.sun_map.w,
            zenith_map_from_base=scene.zenith_map.map_from_base,
            zenith_map=scene.zenith_map.w,
            palette=scene.palette,
        ),
        shade.Lens(
            base_from_camera=np.array(base_from_camera),
            pinhole=np.array(pinhole),
            air=np.array(air),
        ),
        picture.triangle,
        1.0 / picture.depth_m,
        fine_triangle,
        fine_inverse,
        out,
    )
    return out


def _doubled(intrinsics: Intrinsics) -> Intrinsics:
    """Return the camera with twice as many pixels in the same frame."""
    return Intrinsics(
        fx_px=2 * intrinsics.fx_px,
        fy_px=2 * intrinsics.fy_px,
        cx_px=2 * intrinsics.cx_px + 0.5,
        cy_px=2 * intrinsics.cy_px + 0.5,
        width_px=2 * intrinsics.width_px,
        height_px=2 * intrinsics.height_px,
    )


def develop(
    linear: Float32Array, scene: Scene, rng: np.random.Generator, *, blur_px: float = 0.45
) -> UInt8Array:
    """Return (H, W, 3) uint8 sRGB: lens blur, vignetting, exposure, photon and read noise."""
    light = scene.light
    height, width = linear.shape[:2]
    image = cv2.GaussianBlur(linear, (0, 0), blur_px)
    v, u = np.ogrid[-1 : 1 : height * 1j, -1 : 1 : width * 1j]
    fall = (1 - 0.16 * (u * u + v * v)).astype(np.float32)
    gain = 1.08 * light.exposure * float(np.exp(rng.normal(0, 0.04)))
    white = np.array([light.white[0], 1, light.white[1]], dtype=np.float32)
    image = image * (gain * fall)[..., None] * white
    image = (1 - np.exp(-image)) ** np.float32(1.12)
    sigma = np.sqrt(np.maximum(image, 0) * 2.0e-4 + 1.2e-6)
    image += sigma * rng.standard_normal(image.shape, dtype=np.float32)
    np.clip(image, 0, 1, out=image)
    low = image * 12.92
    high = 1.055 * np.power(image, 1 / 2.4) - 0.055
    return np.asarray(np.rint(255 * np.where(image < 0.0031308, low, high))).astype(np.uint8)
