"""The paper's map update, literally: every voxel of a box, every segment, floating point."""

import math

import numpy as np


def likelihood(segments, voxel_size_m, k, max_confidence, low, high):
    """p_l of all voxels in [low, high) by equations 1 and 2, rule 1 where the segment passes."""
    p = np.zeros(np.subtract(high, low))
    pieces = zip(
        segments.starts_in_base,
        segments.ends_in_base,
        segments.radius_m,
        np.minimum(segments.confidence, max_confidence),
        strict=True,
    )
    for start, end, radius, confidence in pieces:
        for place in np.ndindex(*p.shape):
            voxel = np.add(place, low)
            p_o = observed(voxel, start, end, radius, confidence, voxel_size_m, k)
            p[place] = 1 - (1 - p[place]) * (1 - p_o)
    return p


def observed(voxel, start, end, radius, confidence, voxel_size_m, k):
    if meets(voxel, start / voxel_size_m, end / voxel_size_m):
        return confidence
    length = math.dist(start, end)
    axis = (end - start) / length
    offset = (voxel + 0.5) * voxel_size_m - start
    along = float(offset @ axis)
    d_l = max(0.0, -along, along - length)
    d_r = float(np.linalg.norm(offset - along * axis))
    return max(
        0.0, confidence - confidence / k * math.sqrt((d_l / length) ** 2 + (d_r / radius) ** 2)
    )


def meets(voxel, start, end):
    """Clip the segment by the voxel's three slabs."""
    enter, leave = 0.0, 1.0
    for low, s, d in zip(voxel, start, end - start, strict=True):
        if d == 0.0:
            if not low <= s < low + 1:
                return False
            continue
        a, b = sorted(((low - s) / d, (low + 1 - s) / d))
        enter, leave = max(enter, a), min(leave, b)
    return enter < leave
