"""The sticks of `scenes.wood` with leaves before the gap between the branch and the twig ahead."""

from dataclasses import replace

import numpy as np
from scenes.wood import view_from

GAP = np.array([1.0, 0.21, 0.095])


def leafy_view(index, y=0.0, z=0.0):
    """A view of the sticks in which leaves at 0.7 m hide the gap."""
    plain = view_from(index, y, z)
    depth_m, instances = plain.depth_m.copy(), plain.instances.copy()
    u, v = round(160 - 300 * (GAP[1] - y)), round(120 - 300 * (GAP[2] - z))
    leaf = (slice(max(v - 14, 0), v + 15), slice(max(u - 14, 0), u + 15))
    depth_m[leaf], instances[leaf] = 0.7, 0
    return replace(plain, depth_m=depth_m, instances=instances)
