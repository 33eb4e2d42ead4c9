"""Deferred shading: one pass over the pixels after the z-buffer is full."""

import numpy as np
from numba import njit
from numpy.typing import NDArray

from mock_hw.orchard.kernels import texture

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
I32 = NDArray[np.int32]
U8 = NDArray[np.uint8]

# Kinds as in `mesh.Kind`.
_WOOD, _LEAF, _FRUIT, _POST, _WIRE, _FAR_WOOD, _FAR_LEAF = 2, 3, 4, 5, 6, 7, 8


@njit(cache=True)
def _lit(map_from_base: F64, buffer: F64, x: float, y: float, z: float, bias: float) -> float:
    """Return the share of 3 x 3 shadow-map samples that see the light."""
    u = map_from_base[0, 0] * x + map_from_base[0, 1] * y + map_from_base[0, 2] * z
    v = map_from_base[1, 0] * x + map_from_base[1, 1] * y + map_from_base[1, 2] * z
    w = map_from_base[2, 0] * x + map_from_base[2, 1] * y + map_from_base[2, 2] * z
    i, j = int(np.rint(v + map_from_base[1, 3])), int(np.rint(u + map_from_base[0, 3]))
    height, width = buffer.shape
    if i < 1 or j < 1 or i >= height - 1 or j >= width - 1:
        return 1.0
    w += map_from_base[2, 3] + bias
    seen = 0.0
    for a in range(-1, 2):
        for b in range(-1, 2):
            seen += w >= buffer[i + a, j + b]
    return seen / 9.0


@njit(cache=True)
def _open_sky(map_from_base: F64, buffer: F64, x: float, y: float, z: float) -> float:
    """Return how much of the sky is open over a point: 25 samples of the map from the zenith."""
    j = int(np.rint(map_from_base[0, 0] * x + map_from_base[0, 3]))
    i = int(np.rint(map_from_base[1, 1] * y + map_from_base[1, 3]))
    height, width = buffer.shape
    if i < 16 or j < 16 or i >= height - 16 or j >= width - 16:
        return 1.0
    w = z + map_from_base[2, 3] + 0.02
    seen = 0.0
    for a in range(-2, 3):
        for b in range(-2, 3):
            seen += w >= buffer[i + 7 * a, j + 7 * b]
    return seen / 25.0


@njit(cache=True)
def _surface(
    palette: F64, kind: int, side: int, furrow: float, s: tuple[float, float, float],
    radius: float, tone: float,
) -> tuple[float, float, float]:
    """Return the albedo of a mesh face at texture coordinates `s`."""
    if kind == _WOOD or kind == _FAR_WOOD:
        return texture.bark(palette, furrow, s[0], s[1], s[2], radius, tone)
    if kind == _LEAF or kind == _FAR_LEAF:
        return texture.leaf(palette, side, s[0], s[1], s[2], tone)
    if kind == _FRUIT:
        return texture.fruit(palette, s[0], s[1], s[2], tone)
    if kind == _POST:
        grain = 0.6 + 0.8 * texture.noise(s[0] * 150, s[1] * 150, s[2] * 8)
        post = texture.row(palette, texture.POST)
        return (post[0] * grain, post[1] * grain, post[2] * grain)
    return texture.row(palette, texture.WIRE)


@njit(cache=True)
def _interpolated(
    screen: F64, triangle: I32, values: F32, u: float, v: float
) -> tuple[float, float, float]:
    """Interpolate (P, 3) point values at a pixel, right in perspective."""
    ia, ib, ic = triangle[0], triangle[1], triangle[2]
    ua, va = screen[ia, 0], screen[ia, 1]
    ub, vb = screen[ib, 0], screen[ib, 1]
    uc, vc = screen[ic, 0], screen[ic, 1]
    area = (ub - ua) * (vc - va) - (uc - ua) * (vb - va)
    b = ((u - ua) * (vc - va) - (uc - ua) * (v - va)) / area
    c = ((ub - ua) * (v - va) - (u - ua) * (vb - va)) / area
    a = (1.0 - b - c) * screen[ia, 2]
    b *= screen[ib, 2]
    c *= screen[ic, 2]
    total = a + b + c
    return (
        (a * values[ia, 0] + b * values[ib, 0] + c * values[ic, 0]) / total,
        (a * values[ia, 1] + b * values[ib, 1] + c * values[ic, 1]) / total,
        (a * values[ia, 2] + b * values[ib, 2] + c * values[ic, 2]) / total,
    )


@njit(cache=True)
def shade(
    screen: F64, triangles: I32, normals: F32, coordinates: F32, kind: U8, tone: F32,
    radius: F32, id_buffer: I32, depth: F64, base_from_camera: F64, pinhole: F64, sun: F64,
    sun_map_from_base: F64, sun_map: F64, zenith_map_from_base: F64, zenith_map: F64,
    palette: F64, settings: F64, out: F32,
) -> None:
    """Fill `out` (H, W, 3) with linear radiance.

    `depth` (H, W) is infinite in the sky; `id_buffer` is -1 on ground and sky. pinhole: fx, fy,
    cx, cy. sun: (3,) unit direction to the sun. settings: furrow, cloud, haze_m, flash, row_x,
    row pitch.
    """
    furrow, cloud, haze_m, flash = settings[0], settings[1], settings[2], settings[3]
    rotation, eye = base_from_camera[:3, :3], base_from_camera[:3, 3]
    sun_rgb = texture.row(palette, texture.SUN)
    sky_rgb = texture.row(palette, texture.SKY)
    rim = texture.row(palette, texture.HORIZON)
    height, width = id_buffer.shape
    for v in range(height):
        for u in range(width):
            rx, ry = (u - pinhole[2]) / pinhole[0], (v - pinhole[3]) / pinhole[1]
            dx = rotation[0, 0] * rx + rotation[0, 1] * ry + rotation[0, 2]
            dy = rotation[1, 0] * rx + rotation[1, 1] * ry + rotation[1, 2]
            dz = rotation[2, 0] * rx + rotation[2, 1] * ry + rotation[2, 2]
            stretch = np.sqrt(rx * rx + ry * ry + 1.0)
            z = depth[v, u]
            if np.isinf(z):
                r, g, b = texture.sky(palette, dx / stretch, dy / stretch, dz / stretch, cloud)
                out[v, u, 0], out[v, u, 1], out[v, u, 2] = r, g, b
                continue
            px, py, pz = eye[0] + z * dx, eye[1] + z * dy, eye[2] + z * dz
            distance = z * stretch
            t = id_buffer[v, u]
            nx, ny, nz, what, side = 0.0, 0.0, 1.0, 1, texture.ABOVE
            if t < 0:
                albedo = texture.ground(palette, px, py, distance, settings[4], settings[5])
            else:
                what = kind[t]
                nx, ny, nz = _interpolated(screen, triangles[t], normals, u, v)
                length = np.sqrt(nx * nx + ny * ny + nz * nz) + 1e-12
                facing = -(nx * dx + ny * dy + nz * dz)
                if facing < 0:
                    length, side = -length, texture.BELOW
                nx, ny, nz = nx / length, ny / length, nz / length
                s = _interpolated(screen, triangles[t], coordinates, u, v)
                albedo = _surface(palette, what, side, furrow, s, radius[t], tone[t])
            direct = nx * sun[0] + ny * sun[1] + nz * sun[2]
            if what >= _FAR_WOOD:
                lit = 0.25 + 0.75 * (tone[t] > 0.4)
                sky_open = 0.35 + 0.5 * tone[t]
            else:
                lit = _lit(sun_map_from_base, sun_map, px, py, pz, 0.006)
                sky_open = _open_sky(zenith_map_from_base, zenith_map, px, py, pz)
            sky_open = 0.28 + 0.72 * sky_open
            leafy = what == _LEAF or what == _FAR_LEAF
            gloss = 0.0
            through = (0.0, 0.0, 0.0)
            if leafy and direct < 0:
                through = texture.row(palette, texture.THROUGH)
                shine = -direct * lit * (0.55 + 0.7 * tone[t])
                through = (through[0] * shine, through[1] * shine, through[2] * shine)
            if (leafy and side == texture.ABOVE) or what == _FRUIT or what == _WIRE:
                hx, hy, hz = sun[0] - dx / stretch, sun[1] - dy / stretch, sun[2] - dz / stretch
                half = (nx * hx + ny * hy + nz * hz) / np.sqrt(hx * hx + hy * hy + hz * hz)
                gloss = 0.22 * lit * max(half, 0.0) ** 28 + 0.03 * (0.5 + 0.5 * nz) * sky_open
            near = flash * max(-(nx * dx + ny * dy + nz * dz) / stretch, 0.0) / (distance**2)
            up, down = 0.5 + 0.5 * nz, 0.5 - 0.5 * nz
            haze = 1 - np.exp(-distance / haze_m)
            direct = max(direct, 0.0) * lit
            for k in range(3):
                light = sun_rgb[k] * direct + near
                light += (0.6 * sky_rgb[k] + 0.4 * rim[k]) * up * sky_open
                light += down * 0.12 * (sun_rgb[k] + rim[k]) * sky_open
                value = albedo[k] * light + sun_rgb[k] * (through[k] + gloss)
                out[v, u, k] = value + (rim[k] - value) * haze
