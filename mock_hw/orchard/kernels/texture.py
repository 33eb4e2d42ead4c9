"""Procedural colours, locked to the thing they lie on: bark, leaves, fruit, grass, sky."""

import numpy as np
from numba import njit
from numpy.typing import NDArray

F64 = NDArray[np.float64]
Rgb = tuple[float, float, float]

# Rows of the palette.
BARK, SHOOT, ABOVE, BELOW, THROUGH, FRUIT, CHEEK = range(7)
POST, WIRE, GRASS, SOIL, SUN, SKY, HORIZON, HEDGE = range(7, 15)


@njit(cache=True)
def _hash(x: int, y: int, z: int) -> float:
    h = (x * 374761393 + y * 668265263 + z * 2147483647) & 0xFFFFFFFF
    h = ((h ^ (h >> 13)) * 1274126177) & 0xFFFFFFFF
    h = ((h ^ (h >> 16)) * 2246822519) & 0xFFFFFFFF
    return ((h ^ (h >> 15)) & 0xFFFFFF) / 16777216.0


@njit(cache=True)
def noise(x: float, y: float, z: float) -> float:
    """Return smooth value noise in [0, 1] with one cell per unit."""
    fx, fy, fz = np.floor(x), np.floor(y), np.floor(z)
    i, j, k = int(fx), int(fy), int(fz)
    a, b, c = x - fx, y - fy, z - fz
    a, b, c = a * a * (3 - 2 * a), b * b * (3 - 2 * b), c * c * (3 - 2 * c)
    low = _hash(i, j, k) * (1 - a) + _hash(i + 1, j, k) * a
    low = low * (1 - b) + (_hash(i, j + 1, k) * (1 - a) + _hash(i + 1, j + 1, k) * a) * b
    high = _hash(i, j, k + 1) * (1 - a) + _hash(i + 1, j, k + 1) * a
    high = high * (1 - b) + (_hash(i, j + 1, k + 1) * (1 - a) + _hash(i + 1, j + 1, k + 1) * a) * b
    return float(low * (1 - c) + high * c)


@njit(cache=True)
def _mix(a: Rgb, b: Rgb, t: float) -> Rgb:
    t = min(max(t, 0.0), 1.0)
    return (a[0] + (b[0] - a[0]) * t, a[1] + (b[1] - a[1]) * t, a[2] + (b[2] - a[2]) * t)


@njit(cache=True)
def _scaled(a: Rgb, s: float) -> Rgb:
    return (a[0] * s, a[1] * s, a[2] * s)


@njit(cache=True)
def row(palette: F64, index: int) -> Rgb:
    """Return one colour of the palette."""
    return (palette[index, 0], palette[index, 1], palette[index, 2])


@njit(cache=True)
def bark(palette: F64, furrow: float, x: float, y: float, z: float, r: float, tone: float) -> Rgb:
    """Return the colour of wood of radius r at straightened coordinates (metres)."""
    young = min(max((0.0055 - r) / 0.0025, 0.0), 1.0)
    base = _mix(row(palette, BARK), row(palette, SHOOT), young * (0.6 + 0.4 * tone))
    seed = 37.0 * tone
    ridge = noise(x * 210, y * 210, z * 38 + seed)
    crack = abs(2 * noise(x * 120 + 9, y * 120, z * 22 + seed) - 1)
    fine = noise(x * 700, y * 700, z * 420 + seed)
    old = furrow * (1 - young)
    base = _scaled(base, 0.72 + 0.34 * fine + old * (0.55 * ridge - 0.25))
    if crack < 0.22:
        base = _scaled(base, 1 - old * 0.75 * (1 - crack / 0.22))
    patch = noise(x * 60 + 50, y * 60, z * 30 + seed) + 0.35 * fine
    lichen = (0.30, 0.33, 0.24)
    return _mix(base, lichen, (patch - 0.92) * 3.5 * (1 - 0.7 * young))


@njit(cache=True)
def leaf(palette: F64, side: int, x: float, y: float, stalk: float, tone: float) -> Rgb:
    """Return the colour of a leaf's side (ABOVE or BELOW) along and across its midrib."""
    base = row(palette, side)
    fresh = tone * tone
    base = (base[0] * (0.75 + 0.9 * fresh), base[1] * (0.8 + 0.5 * fresh), base[2] * 0.95)
    if stalk > 0.5:
        return _mix(base, (0.20, 0.17, 0.06), 0.55)
    across = abs(y)
    vein = (x - 0.85 * across) * 8.0
    vein = abs(vein - np.floor(vein) - 0.5)
    lines = max(1 - across / 0.014, 0.0) + 0.5 * max(1 - vein / 0.06, 0.0)
    blotch = noise(x * 5 + 91 * tone, y * 9, tone * 53)
    base = _scaled(base, 0.78 + 0.42 * blotch)
    base = _mix(base, (0.22, 0.30, 0.10), 0.45 * min(lines, 1.0))
    if tone > 0.93 and noise(x * 9 + 31 * tone, y * 14, 3.0) > 0.66:
        base = (0.16, 0.10, 0.03)
    return base


@njit(cache=True)
def fruit(palette: F64, x: float, y: float, z: float, tone: float) -> Rgb:
    """Return the colour of a globe at unit coordinates."""
    streak = noise(x * 7 + 17 * tone, y * 7, z * 2)
    cheek = 0.9 * x * np.cos(6.3 * tone) + 0.9 * y * np.sin(6.3 * tone) + 0.7 * streak
    base = _mix(row(palette, FRUIT), row(palette, CHEEK), cheek + 0.7 * tone)
    speck = noise(x * 26, y * 26, z * 26 + tone)
    base = _mix(base, (0.42, 0.36, 0.16), (speck - 0.82) * 2.0)
    return _scaled(base, 0.85 + 0.3 * streak)


@njit(cache=True)
def ground(palette: F64, x: float, y: float, distance: float, row_x: float, pitch: float) -> Rgb:
    """Return the colour of the orchard floor: grass, bare soil under the rows, litter."""
    far = min(distance / 9.0, 1.0)
    broad = noise(x * 1.3, y * 1.3, 5.0)
    tuft = noise(x * 14, y * 14, 1.0)
    blade = noise(x * 150, y * 60, 2.0) * (1 - far) + 0.5 * far
    grass = _scaled(row(palette, GRASS), 0.35 + 0.5 * broad + 0.5 * tuft + 0.9 * (blade - 0.3))
    grass = _mix(grass, (0.24, 0.21, 0.08), 0.5 * (noise(x * 3, y * 3, 9.0) - 0.3) + 0.3 * blade)
    crumb = noise(x * 75, y * 75, 4.0) * (1 - far) + 0.5 * far
    soil = _scaled(row(palette, SOIL), 0.5 + 0.5 * tuft + 0.7 * crumb)
    litter = noise(x * 33, y * 33, 8.0)
    soil = _mix(soil, (0.21, 0.14, 0.06), (litter - 0.72) * 6)
    offset = abs((x - row_x) / pitch - np.floor((x - row_x) / pitch + 0.5)) * pitch
    edge = 0.42 + 0.22 * (tuft - 0.5) + 0.15 * (broad - 0.5)
    return _mix(soil, grass, (offset - edge) / 0.08 + 0.5)


@njit(cache=True)
def sky(palette: F64, x: float, y: float, z: float, cloud: float) -> Rgb:
    """Return the sky, or the far hedge, in a unit direction."""
    bearing = np.arctan2(y, x)
    hedge = 0.02 + 0.05 * noise(bearing * 6, 1.0, 0.0) + 0.03 * noise(bearing * 26, 2.0, 0.0)
    hedge += 0.012 * noise(bearing * 120, z * 60, 4.0)
    if z < hedge:
        leafy = 0.6 * noise(bearing * 90, z * 110, 3.0) + 0.4 * noise(bearing * 260, z * 260, 5.0)
        crown = noise(bearing * 26, 2.0, 0.0)
        dark = _scaled(row(palette, HEDGE), 0.3 + 0.8 * leafy + 0.6 * crown)
        return _mix(dark, row(palette, HORIZON), 0.12)
    height = min(max(z, 0.0) * 1.6, 1.0)
    base = _mix(row(palette, HORIZON), row(palette, SKY), height**0.6)
    s = 1.0 / (z + 0.12)
    puff = 0.6 * noise(x * s * 1.4, y * s * 1.4, 7.0) + 0.3 * noise(x * s * 3.3, y * s * 3.3, 8.0)
    puff += 0.15 * noise(x * s * 8, y * s * 8, 9.0)
    white = row(palette, HORIZON)
    return _mix(base, (white[0] * 1.1, white[1] * 1.08, white[2] * 1.05), (puff - 0.62 + cloud) * 3)
