"""Which voxels lie inside tapered tubes: volume without counting any place twice.

Lengths are in voxels; voxel (x, y, z) has its centre at (x + 0.5, y + 0.5, z + 0.5).
"""

import math

import numpy as np
from numpy.typing import NDArray

from canopy_skel.kernels.compiled import inner, kernel

Floats = NDArray[np.float64]
Int32s = NDArray[np.int32]
UInt8s = NDArray[np.uint8]


@inner("UniTuple(int64, 2)(float64, float64, float64)")
def first_and_last(a: float, b: float, radius: float) -> tuple[int, int]:
    """Return [first, last) voxel whose centre lies within `radius` of the span from a to b."""
    low, high = min(a, b) - radius, max(a, b) + radius
    return max(math.ceil(low - 0.5), 0), math.floor(high - 0.5) + 1


@kernel("void(float64[:,::1], float64[:,::1], float64[:,::1], int32[:,:,::1])")
def mark_blocks(starts: Floats, ends: Floats, radii: Floats, top: Int32s) -> None:
    """Set top = 1 for every 8^3 block that the box around some tube touches."""
    for i in range(len(starts)):
        radius = max(radii[i, 0], radii[i, 1])
        x0, x1 = first_and_last(starts[i, 0], ends[i, 0], radius)
        y0, y1 = first_and_last(starts[i, 1], ends[i, 1], radius)
        z0, z1 = first_and_last(starts[i, 2], ends[i, 2], radius)
        for x in range(x0 >> 3, (x1 + 7) >> 3):
            for y in range(y0 >> 3, (y1 + 7) >> 3):
                for z in range(z0 >> 3, (z1 + 7) >> 3):
                    top[x, y, z] = 1


@kernel("void(float64[:,::1], float64[:,::1], float64[:,::1], int32[:,:,::1], uint8[:,::1])")
def fill_tubes(starts: Floats, ends: Floats, radii: Floats, top: Int32s, filled: UInt8s) -> None:
    """Set filled[top[block], offset] = 1 for the voxels inside some tube.

    A voxel is inside when its centre is no further from the axis than the radius (N, 2: at start
    and end) at the nearest point of the axis, so that tubes end in half balls.
    """
    for i in range(len(starts)):
        ax, ay, az = starts[i, 0], starts[i, 1], starts[i, 2]
        dx, dy, dz = ends[i, 0] - ax, ends[i, 1] - ay, ends[i, 2] - az
        square = max(dx * dx + dy * dy + dz * dz, 1e-12)
        r0, taper = radii[i, 0], radii[i, 1] - radii[i, 0]
        radius = max(radii[i, 0], radii[i, 1])
        x0, x1 = first_and_last(ax, ax + dx, radius)
        y0, y1 = first_and_last(ay, ay + dy, radius)
        z0, z1 = first_and_last(az, az + dz, radius)
        for x in range(x0, x1):
            for y in range(y0, y1):
                for z in range(z0, z1):
                    px, py, pz = x + 0.5 - ax, y + 0.5 - ay, z + 0.5 - az
                    at = min(max((px * dx + py * dy + pz * dz) / square, 0.0), 1.0)
                    ox, oy, oz = px - at * dx, py - at * dy, pz - at * dz
                    here = r0 + at * taper
                    if ox * ox + oy * oy + oz * oz <= here * here:
                        block = top[x >> 3, y >> 3, z >> 3]
                        filled[block, ((x & 7) << 6) | ((y & 7) << 3) | (z & 7)] = 1
