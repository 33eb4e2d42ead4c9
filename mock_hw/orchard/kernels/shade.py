"""Deferred shading: colours for a full z-buffer, with four samples where surfaces meet."""

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from mock_hw.orchard.kernels import texture
from mock_hw.orchard.mesh import Kind

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
I32 = NDArray[np.int32]
U8 = NDArray[np.uint8]
Vec = tuple[float, float, float]

_GROUND, _WOOD, _LEAF, _FRUIT = int(Kind.GROUND), int(Kind.WOOD), int(Kind.LEAF), int(Kind.FRUIT)
_POST, _FAR_WOOD, _FAR_LEAF = int(Kind.POST), int(Kind.FAR_WOOD), int(Kind.FAR_LEAF)
_WIRE = int(Kind.WIRE)
_GROUND_ENDS_M = 26.0


class Surfaces(NamedTuple):
    """The mesh as `mesh.Mesh` has it, projected: screen (P, 3), u, v and 1/z per point."""

    screen: F64
    triangles: I32
    normals: F32
    coordinates: F32
    kind: U8
    tone: F32
    radius: F32


class Lights(NamedTuple):
    """sun: (3,) direction. Maps as `scene.ShadowMap` has them. palette: see `texture`."""

    sun: F64
    sun_map_from_base: F64
    sun_map: F64
    zenith_map_from_base: F64
    zenith_map: F64
    palette: F64


class Lens(NamedTuple):
    """pinhole: fx, fy, cx, cy. air: furrow, cloud, haze_m, flash, row_x, row pitch."""

    base_from_camera: F64
    pinhole: F64
    air: F64


@njit(cache=True)
def _dot(a: Vec, b: Vec) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@njit(cache=True)
def _sunlit(lights: Lights, p: Vec) -> float:
    """Return the share of 3 x 3 shadow-map samples that see the sun."""
    m, buffer = lights.sun_map_from_base, lights.sun_map
    j = int(np.rint(m[0, 0] * p[0] + m[0, 1] * p[1] + m[0, 2] * p[2] + m[0, 3]))
    i = int(np.rint(m[1, 0] * p[0] + m[1, 1] * p[1] + m[1, 2] * p[2] + m[1, 3]))
    height, width = buffer.shape
    if i < 1 or j < 1 or i >= height - 1 or j >= width - 1:
        return 1.0
    w = m[2, 0] * p[0] + m[2, 1] * p[1] + m[2, 2] * p[2] + m[2, 3] + 0.007
    seen = 0.0
    for a in range(-1, 2):
        for b in range(-1, 2):
            seen += w >= buffer[i + a, j + b]
    return seen / 9.0


@njit(cache=True)
def _open_sky(lights: Lights, p: Vec) -> float:
    """Return how much of the sky is open over a point: 25 samples of the map from the zenith."""
    m, buffer = lights.zenith_map_from_base, lights.zenith_map
    j = int(np.rint(m[0, 0] * p[0] + m[0, 3]))
    i = int(np.rint(m[1, 1] * p[1] + m[1, 3]))
    height, width = buffer.shape
    if i < 16 or j < 16 or i >= height - 16 or j >= width - 16:
        return 1.0
    w = p[2] + m[2, 3] + 0.02
    seen = 0.0
    for a in range(-2, 3):
        for b in range(-2, 3):
            seen += w >= buffer[i + 7 * a, j + 7 * b]
    return 0.25 + 0.75 * seen / 25.0


@njit(cache=True)
def _weights(surfaces: Surfaces, t: int, u: float, v: float) -> Vec:
    """Return the barycentric weights of a pixel position, right in perspective."""
    screen, triangle = surfaces.screen, surfaces.triangles[t]
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
    return a / total, b / total, c / total


@njit(cache=True)
def _blend(values: F32, triangle: I32, weights: Vec) -> Vec:
    a, b, c = values[triangle[0]], values[triangle[1]], values[triangle[2]]
    return (
        a[0] * weights[0] + b[0] * weights[1] + c[0] * weights[2],
        a[1] * weights[0] + b[1] * weights[1] + c[1] * weights[2],
        a[2] * weights[0] + b[2] * weights[1] + c[2] * weights[2],
    )


@njit(cache=True)
def _albedo(
    surfaces: Surfaces, palette: F64, furrow: float, t: int, side: int, weights: Vec
) -> Vec:
    """Return the reflectance of a mesh face."""
    kind, tone = surfaces.kind[t], surfaces.tone[t]
    s = _blend(surfaces.coordinates, surfaces.triangles[t], weights)
    if kind in (_WOOD, _FAR_WOOD):
        return texture.bark(palette, furrow, s[0], s[1], s[2], surfaces.radius[t], tone)
    if kind in (_LEAF, _FAR_LEAF):
        return texture.leaf(palette, side, s[0], s[1], s[2], tone)
    if kind == _FRUIT:
        return texture.fruit(palette, s[0], s[1], s[2], tone)
    if kind == _POST:
        grain = 0.6 + 0.8 * texture.noise(s[0] * 150, s[1] * 150, s[2] * 8)
        post = texture.row(palette, texture.POST)
        return post[0] * grain, post[1] * grain, post[2] * grain
    return texture.row(palette, texture.WIRE)


@njit(cache=True)
def _facing(surfaces: Surfaces, t: int, weights: Vec, ray: Vec) -> tuple[Vec, int]:
    """Return the unit normal on the viewer's side, and which side of a leaf that is."""
    n = _blend(surfaces.normals, surfaces.triangles[t], weights)
    length = np.sqrt(_dot(n, n)) + 1e-12
    side = texture.ABOVE
    if _dot(n, ray) > 0:
        length, side = -length, texture.BELOW
    return (n[0] / length, n[1] / length, n[2] / length), side


@njit(cache=True)
def _sheen(n: Vec, sun: F64, ray: Vec) -> float:
    """Return the mirror part of sunlight (Blinn-Phong)."""
    h = (sun[0] - ray[0], sun[1] - ray[1], sun[2] - ray[2])
    cosine = _dot(n, h) / np.sqrt(_dot(h, h))
    return float(0.16 * max(cosine, 0.0) ** 30)


@njit(cache=True)
def _lit(
    lights: Lights,
    flash: float,
    what: int,
    side: int,
    tone: float,
    albedo: Vec,
    n: Vec,
    p: Vec,
    ray: Vec,
    distance: float,
) -> Vec:
    """Return the light a surface point sends to the lens: sun, sky, ground, lamp."""
    palette, sun = lights.palette, lights.sun
    if what >= _FAR_WOOD:
        shadow, open_sky = 0.2 + 0.8 * (tone > 0.45), 0.35 + 0.5 * tone
    else:
        shadow, open_sky = _sunlit(lights, p), _open_sky(lights, p)
    direct = n[0] * sun[0] + n[1] * sun[1] + n[2] * sun[2]
    leafy = what in (_LEAF, _FAR_LEAF)
    through = -direct * shadow * (0.5 + 0.6 * tone) if leafy and direct < 0 else 0.0
    glossy = (leafy and side == texture.ABOVE) or what in (_FRUIT, _WIRE)
    mirror = _sheen(n, sun, ray) * shadow if glossy else 0.0
    lamp = flash * max(-_dot(n, ray), 0.0) / distance**2
    sun_rgb = texture.row(palette, texture.SUN)
    sky_rgb, rim = texture.row(palette, texture.SKY), texture.row(palette, texture.HORIZON)
    below = texture.row(palette, texture.GRASS)
    glow = texture.row(palette, texture.THROUGH)
    up = 0.5 + 0.5 * n[2]
    direct = max(direct, 0.0) * shadow
    out = np.empty(3)
    for k in range(3):
        sky_light = (0.6 * sky_rgb[k] + 0.4 * rim[k]) * up * open_sky
        ground_light = (1 - up) * 1.2 * below[k] * (sun_rgb[k] + rim[k]) * open_sky
        out[k] = albedo[k] * (sun_rgb[k] * direct + sky_light + ground_light + lamp)
        out[k] += sun_rgb[k] * (glow[k] * through + mirror)
        out[k] += glossy * 0.02 * sky_rgb[k] * up * open_sky
    return out[0], out[1], out[2]


@njit(cache=True)
def _sample(
    surfaces: Surfaces, lights: Lights, lens: Lens, u: float, v: float, t: int, w: float
) -> Vec:
    """Return the linear radiance of triangle t (-1: ground or sky) at 1/z = w."""
    rotation, eye, pinhole, air = (
        lens.base_from_camera[:3, :3],
        lens.base_from_camera[:3, 3],
        lens.pinhole,
        lens.air,
    )
    x, y = (u - pinhole[2]) / pinhole[0], (v - pinhole[3]) / pinhole[1]
    length = np.sqrt(x * x + y * y + 1.0)
    ray = (
        (rotation[0, 0] * x + rotation[0, 1] * y + rotation[0, 2]) / length,
        (rotation[1, 0] * x + rotation[1, 1] * y + rotation[1, 2]) / length,
        (rotation[2, 0] * x + rotation[2, 1] * y + rotation[2, 2]) / length,
    )
    palette = lights.palette
    if w <= 0 or (t < 0 and length > w * _GROUND_ENDS_M):
        return texture.sky(palette, ray[0], ray[1], ray[2], air[1])
    distance = length / w
    p = (eye[0] + distance * ray[0], eye[1] + distance * ray[1], eye[2] + distance * ray[2])
    if t < 0:
        albedo = texture.ground(palette, p[0], p[1], distance, air[4], air[5])
        up = (0.0, 0.0, 1.0)
        value = _lit(lights, air[3], _GROUND, 0, 0.5, albedo, up, p, ray, distance)
    else:
        weights = _weights(surfaces, t, u, v)
        n, side = _facing(surfaces, t, weights, ray)
        albedo = _albedo(surfaces, palette, air[0], t, side, weights)
        what, tone = surfaces.kind[t], surfaces.tone[t]
        value = _lit(lights, air[3], what, side, tone, albedo, n, p, ray, distance)
    haze = 1 - np.exp(-distance / air[2])
    rim = texture.row(palette, texture.HORIZON)
    return (
        value[0] + (rim[0] - value[0]) * haze,
        value[1] + (rim[1] - value[1]) * haze,
        value[2] + (rim[2] - value[2]) * haze,
    )


@njit(cache=True)
def _alike(surfaces: Surfaces, a: int, b: int) -> bool:
    """Say whether two triangles belong to one object, so that no edge runs between them."""
    if a < 0 or b < 0:
        return a == b
    return a == b or (surfaces.kind[a] == surfaces.kind[b] and surfaces.tone[a] == surfaces.tone[b])


@njit(cache=True, nogil=True)
def shade(
    surfaces: Surfaces,
    lights: Lights,
    lens: Lens,
    triangle: I32,
    w: F64,
    fine_triangle: I32,
    fine_w: F64,
    out: F32,
) -> None:
    """Fill `out` (H, W, 3) with linear radiance.

    triangle, w: (H, W) number of the triangle (-1: none) and 1/z at pixel centres; fine_*: the
    same at (2H, 2W), four samples per pixel, a quarter pixel off the centre.
    """
    height, width = triangle.shape
    for v in range(height):
        for u in range(width):
            t = triangle[v, u]
            quad = fine_triangle[2 * v : 2 * v + 2, 2 * u : 2 * u + 2]
            one = True
            for k in range(4):
                one = one and _alike(surfaces, quad[k // 2, k % 2], t)
            if one:
                r, g, b = _sample(surfaces, lights, lens, u, v, t, w[v, u])
                out[v, u, 0], out[v, u, 1], out[v, u, 2] = r, g, b
                continue
            out[v, u] = 0.0
            for k in range(4):
                i, j = k // 2, k % 2
                x, y = u + 0.5 * j - 0.25, v + 0.5 * i - 0.25
                depth = fine_w[2 * v + i, 2 * u + j]
                r, g, b = _sample(surfaces, lights, lens, x, y, quad[i, j], depth)
                out[v, u, 0] += 0.25 * r
                out[v, u, 1] += 0.25 * g
                out[v, u, 2] += 0.25 * b
