"""Circles through bark and within outlines: where the axis of thick wood is, and how thick it is.

Everything is seen along a direction: bark lies on a circle, an outline is a tangent to it.
"""

from math import exp, log, sqrt

import numpy as np
from numpy.typing import NDArray

from canopy_skel.kernels.compiled import inner, kernel

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

FIT = 7
"""Figures of a fit: centre (3), radius, deviation of its logarithm, share of the bark on it; a
radius that few pieces there exceed."""
_BINS, _BIN_M = 160, 0.001
_STEPS = 15
_MOST_M, _MOST_LOG = 0.01, 0.3
_SOFT = 2.0
"""Residuals of so many deviations count a quarter (Geman-McClure)."""
_ON = 2.5
_SMALL, _SETTLED = 1e-6, 3e-4


@inner("void(float64, float64, float64, float64[::1])")
def _across(dx: float, dy: float, dz: float, out: Floats) -> None:
    """Write two unit vectors across a unit direction."""
    if abs(dz) < 0.9:
        ax, ay, az = dy, -dx, 0.0
    else:
        ax, ay, az = 0.0, dz, -dy
    length = sqrt(ax * ax + ay * ay + az * az)
    ax, ay, az = ax / length, ay / length, az / length
    out[0], out[1], out[2] = ax, ay, az
    out[3], out[4], out[5] = dy * az - dz * ay, dz * ax - dx * az, dx * ay - dy * ax


@inner("void(float64[:,::1], float64[::1], float64[::1])")
def _solved(h: Floats, g: Floats, out: Floats) -> None:
    """Write the solution (3,) of a symmetric 3 x 3 system, then the last variance."""
    a, b, c = h[0, 0], h[0, 1], h[0, 2]
    d, e, f = h[1, 1], h[1, 2], h[2, 2]
    m00, m01, m02 = d * f - e * e, c * e - b * f, b * e - c * d
    m11, m12, m22 = a * f - c * c, b * c - a * e, a * d - b * b
    det = a * m00 + b * m01 + c * m02
    out[0] = (m00 * g[0] + m01 * g[1] + m02 * g[2]) / det
    out[1] = (m01 * g[0] + m11 * g[1] + m12 * g[2]) / det
    out[2] = (m02 * g[0] + m12 * g[1] + m22 * g[2]) / det
    out[3] = m22 / det


@inner(
    "float64(float64[:,::1], int64, float64[:,::1], int64, float64, float64, float64[::1],"
    " float64[::1])"
)
def _fitted(
    bark: Floats,
    points: int,
    tangents: Floats,
    lines: int,
    start_m: float,
    expected_m: float,
    limits: Floats,
    out: Floats,
) -> float:
    """Write the best circle from a start: centre (2), radius, deviation, share on it; its cost.

    bark: (N, 4) places and rays, across. tangents: (M, 3) normals and offsets.
    """
    bark_m, line_m, spread, most = limits[4], limits[5], limits[6], limits[7]
    x, y = 0.0, 0.0
    for k in range(points):
        x += bark[k, 0] + start_m * bark[k, 2]
        y += bark[k, 1] + start_m * bark[k, 3]
    x, y, size = x / points, y / points, log(start_m)
    of_bark = min(1.0, most / points)
    of_line = min(1.0, most / lines) if lines else 0.0
    h, g, step = np.empty((3, 3)), np.empty(3), np.empty(4)
    for _ in range(_STEPS):
        radius_m = exp(size)
        for a in range(3):
            g[a] = 0.0
            for b in range(3):
                h[a, b] = _SMALL if a == b and a < 2 else 0.0
        h[2, 2] += 1.0 / spread**2
        g[2] += (size - log(expected_m)) / spread**2
        for k in range(points + lines):
            if k < points:
                wx, wy = bark[k, 0] - x, bark[k, 1] - y
                away = sqrt(wx * wx + wy * wy) + 1e-9
                r = (away - radius_m) / bark_m
                jx, jy, jr = -wx / away / bark_m, -wy / away / bark_m, -radius_m / bark_m
                share = of_bark
            else:
                n = k - points
                r = (tangents[n, 0] * x + tangents[n, 1] * y - tangents[n, 2] - radius_m) / line_m
                jx, jy, jr = tangents[n, 0] / line_m, tangents[n, 1] / line_m, -radius_m / line_m
                share = of_line
            weight = share / (1.0 + (r / _SOFT) ** 2) ** 2
            g[0] += weight * jx * r
            g[1] += weight * jy * r
            g[2] += weight * jr * r
            h[0, 0] += weight * jx * jx
            h[0, 1] += weight * jx * jy
            h[0, 2] += weight * jx * jr
            h[1, 1] += weight * jy * jy
            h[1, 2] += weight * jy * jr
            h[2, 2] += weight * jr * jr
        _solved(h, g, step)
        x -= min(max(step[0], -_MOST_M), _MOST_M)
        y -= min(max(step[1], -_MOST_M), _MOST_M)
        size -= min(max(step[2], -_MOST_LOG), _MOST_LOG)
        if max(abs(step[0]), abs(step[1]), abs(step[2])) < _SETTLED:
            break
    radius_m = exp(size)
    cost: float = ((size - log(expected_m)) / spread) ** 2
    on = 0
    for k in range(points):
        wx, wy = bark[k, 0] - x, bark[k, 1] - y
        r = (sqrt(wx * wx + wy * wy) - radius_m) / bark_m
        on += abs(r) < _ON
        cost += of_bark * r * r / (1.0 + (r / _SOFT) ** 2)
    for n in range(lines):
        r = (tangents[n, 0] * x + tangents[n, 1] * y - tangents[n, 2] - radius_m) / line_m
        cost += of_line * r * r / (1.0 + (r / _SOFT) ** 2)
    out[0], out[1], out[2] = x, y, radius_m
    out[3], out[4] = sqrt(max(step[3], 0.0)), on / points
    return cost


@inner(
    "int64(float64[:,::1], int64, int64, int64, float64[::1], float64, float64, float64,"
    " float64[::1], int64[::1])"
)
def _beside(
    lines: Floats,
    first: int,
    end: int,
    at: int,
    way: Floats,
    x: float,
    y: float,
    z: float,
    limits: Floats,
    found: Ints,
) -> int:
    """Write which of lines[first:end] are beside (x, y, z), and run along a way; how many.

    The direction of a line is that of its piece, figures `at` to `at` + 2.
    """
    dx, dy, dz = way[0], way[1], way[2]
    min_cosine, reach_m, side_m = limits[0], limits[1], limits[2]
    count = 0
    for k in range(first, end):
        wx, wy, wz = lines[k, 0] - x, lines[k, 1] - y, lines[k, 2] - z
        along = wx * dx + wy * dy + wz * dz
        if abs(along) >= reach_m:
            continue
        if wx * wx + wy * wy + wz * wz - along * along >= side_m * side_m:
            continue
        cosine = lines[k, at] * dx + lines[k, at + 1] * dy + lines[k, at + 2] * dz
        if abs(cosine) >= min_cosine:
            found[count] = k
            count += 1
    return count


@inner("void(float64[::1], float64, float64, float64, float64[::1], float64[::1])")
def _tangent(line: Floats, x: float, y: float, z: float, way: Floats, out: Floats) -> None:
    """Write the unit normal (3) of a ray across a direction, into the wood, and its offset."""
    dx, dy, dz = way[0], way[1], way[2]
    nx = dy * line[5] - dz * line[4]
    ny = dz * line[3] - dx * line[5]
    nz = dx * line[4] - dy * line[3]
    length = sqrt(nx * nx + ny * ny + nz * nz) + 1e-9
    if nx * line[6] + ny * line[7] + nz * line[8] < 0.0:
        length = -length
    out[0], out[1], out[2] = nx / length, ny / length, nz / length
    out[3] = out[0] * (line[0] - x) + out[1] * (line[1] - y) + out[2] * (line[2] - z)


@kernel(
    "float64[:,::1](float64[:,::1], float64[:,::1], float64[:,::1], int64[:,::1], int64[:,::1],"
    " float64[::1])"
)
def fits(
    places: Floats,
    bark: Floats,
    outline: Floats,
    bark_window: Ints,
    outline_window: Ints,
    limits: Floats,
) -> Floats:
    """Return the circles (K, FIT) around places (K, 6: point and direction); radius 0: none.

    bark: (N, 10), outline: (M, 12), see `canopy_skel.outlines`; windows: (K, 2), which of them are
    asked. limits: least cosine between directions, how far along and across, fewest points, noise
    of bark and of outlines, spread of the logarithm of the radius, how many points count as so
    many, ratio of the expected radius to that of the pieces, second start, most points, most
    outlines, least radius of the pieces.
    """
    result = np.zeros((len(places), FIT))
    most_points, most_lines = int(limits[10]), int(limits[11])
    near = np.empty(max(len(bark), len(outline)) + 1, dtype=np.int64)
    flat, tangents = np.empty((most_points, 4)), np.empty((most_lines, 3))
    basis, normal, found = np.empty(6), np.empty(4), np.empty(5)
    histogram = np.empty(_BINS, dtype=np.int64)
    for i in range(len(places)):
        x, y, z, way = places[i, 0], places[i, 1], places[i, 2], places[i, 3:]
        histogram[:] = 0
        first, end = bark_window[i, 0], bark_window[i, 1]
        count = _beside(bark, first, end, 6, way, x, y, z, limits, near)
        if count < limits[3]:
            continue
        for k in near[:count]:
            histogram[min(int(bark[k, 9] / _BIN_M), _BINS - 1)] += 1
        seen, thickness_m = 0, 0.0
        for b in range(_BINS):
            seen += histogram[b]
            if seen >= 0.9 * count:
                thickness_m = (b + 0.5) * _BIN_M
                break
        if thickness_m < limits[12]:
            continue
        _across(way[0], way[1], way[2], basis)
        points = min(count, most_points)
        for j in range(points):
            k = near[j * count // points]
            for a in range(2):
                ax, ay, az = basis[3 * a], basis[3 * a + 1], basis[3 * a + 2]
                wx, wy, wz = bark[k, 0] - x, bark[k, 1] - y, bark[k, 2] - z
                flat[j, a] = wx * ax + wy * ay + wz * az
                flat[j, 2 + a] = bark[k, 3] * ax + bark[k, 4] * ay + bark[k, 5] * az
        first, end = outline_window[i, 0], outline_window[i, 1]
        count = _beside(outline, first, end, 9, way, x, y, z, limits, near)
        lines = min(count, most_lines)
        for j in range(lines):
            _tangent(outline[near[j * count // lines]], x, y, z, way, normal)
            for a in range(2):
                ax, ay, az = basis[3 * a], basis[3 * a + 1], basis[3 * a + 2]
                tangents[j, a] = normal[0] * ax + normal[1] * ay + normal[2] * az
            tangents[j, 2] = normal[3]
        best = np.inf
        for start in range(2):
            begin_m = thickness_m * (limits[9] if start else 1.0)
            expected_m = limits[8] * thickness_m
            cost = _fitted(flat, points, tangents, lines, begin_m, expected_m, limits, found)
            if cost < best:
                best = cost
                cx, cy = found[0], found[1]
                for a in range(3):
                    result[i, a] = places[i, a] + cx * basis[a] + cy * basis[3 + a]
                for a in range(3):
                    result[i, 3 + a] = found[2 + a]
        result[i, 6] = thickness_m
    return result


@kernel("int64[:,::1](float64[:,::1], float64[::1], float64[:,::1], int64[:,::1], float64[::1])")
def outlined(axes: Floats, radius_m: Floats, outline: Floats, window: Ints, limits: Floats) -> Ints:
    """Return how many outlines are around cylinders, on them, and run through them (K, 3).

    axes: (K, 6) centres and directions; radius_m: (K,). outline, window, limits: as in `fits`.
    """
    result = np.zeros((len(axes), 3), dtype=np.int64)
    near, normal = np.empty(len(outline) + 1, dtype=np.int64), np.empty(4)
    for i in range(len(axes)):
        x, y, z, way = axes[i, 0], axes[i, 1], axes[i, 2], axes[i, 3:]
        first, end = window[i, 0], window[i, 1]
        result[i, 0] = _beside(outline, first, end, 9, way, x, y, z, limits, near)
        for k in near[: result[i, 0]]:
            _tangent(outline[k], x, y, z, way, normal)
            outside = -normal[3] - radius_m[i]
            result[i, 1] += abs(outside) < 2 * limits[5]
            result[i, 2] += outside < -0.3 * radius_m[i]
    return result


@kernel("float64[:,::1](float64[:,::1], float64[::1], float64[:,::1], float64[::1])")
def onto(points: Floats, radius_m: Floats, axes: Floats, limits: Floats) -> Floats:
    """Return where points that run along within thicker wood belong (N, 7); radius 0: they stay.

    Place, direction, radius: the mean of the axes beside, the nearer along them the more.

    points: (N, 6) with directions; radius_m: (N,). axes: (K, 7) centres, directions, radii. limits:
    least cosine between directions, how far along, how many radii across, least ratio of radii, the
    way along that halves a weight.
    """
    result = np.zeros((len(points), 7))
    for i in range(len(points)):
        total = 0.0
        for k in range(len(axes)):
            wx, wy, wz = (
                points[i, 0] - axes[k, 0],
                points[i, 1] - axes[k, 1],
                points[i, 2] - axes[k, 2],
            )
            dx, dy, dz, thick_m = axes[k, 3], axes[k, 4], axes[k, 5], axes[k, 6]
            along = wx * dx + wy * dy + wz * dz
            if abs(along) >= limits[1] or radius_m[i] * limits[3] >= thick_m:
                continue
            square = wx * wx + wy * wy + wz * wz - along * along
            cosine = points[i, 3] * dx + points[i, 4] * dy + points[i, 5] * dz
            if abs(cosine) <= limits[0] or square >= (limits[2] * thick_m) ** 2:
                continue
            weight = 1.0 / (abs(along) + limits[4])
            sign = weight if cosine > 0.0 else -weight
            result[i, 0] += weight * (axes[k, 0] + along * dx)
            result[i, 1] += weight * (axes[k, 1] + along * dy)
            result[i, 2] += weight * (axes[k, 2] + along * dz)
            result[i, 3] += sign * dx
            result[i, 4] += sign * dy
            result[i, 5] += sign * dz
            result[i, 6] += weight * thick_m
            total += weight
        if total > 0.0:
            length = sqrt(result[i, 3] ** 2 + result[i, 4] ** 2 + result[i, 5] ** 2)
            for a in range(3):
                result[i, a] /= total
                result[i, 3 + a] /= length
            result[i, 6] /= total
    return result
