"""Drawn branches: pictures, masks and lines whose truth is known exactly."""

import itertools

import numpy as np

from canopy_skel.segmenters.labels import LabelledImage

BARK = (110, 90, 75)


def polyline(points, radius_px):
    """A (N, 3) line u, v, radius through points."""
    points = np.asarray(points, dtype=np.float64)
    return np.column_stack([points, np.full(len(points), float(radius_px))])


def straight(centre, angle_deg, length_px, radius_px):
    angle = np.radians(angle_deg)
    half = 0.5 * length_px * np.array([np.cos(angle), np.sin(angle)])
    return polyline([np.subtract(centre, half), np.add(centre, half)], radius_px)


def cover(line, size):
    """The (H, W) pixels whose centres lie within the radius of a line, with square ends."""
    v, u = np.mgrid[: size[0], : size[1]]
    inside = np.zeros(size, bool)
    for a, b in itertools.pairwise(line):
        length = np.linalg.norm((b - a)[:2])
        c, s = (b - a)[:2] / length
        along = c * (u - a[0]) + s * (v - a[1])
        across = c * (v - a[1]) - s * (u - a[0])
        inside |= (along >= 0) & (along <= length) & (np.abs(across) <= a[2])
    return inside


def drawn(lines, size=(240, 320), seed=0):
    """A labelled picture of brown bars on green noise; a later bar lies over an earlier one."""
    rng = np.random.default_rng(seed)
    color = rng.integers(0, 60, (*size, 3)).astype(np.uint8) + np.array([60, 130, 50], np.uint8)
    instances = np.zeros(size, np.uint16)
    for number, line in enumerate(lines, start=1):
        instances[cover(line, size)] = number
    color[instances > 0] = BARK
    return LabelledImage(
        color_rgb=color,
        instances=instances,
        lines=tuple(lines),
        ignore=np.zeros(size, bool),
    )
