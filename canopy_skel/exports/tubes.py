"""Branches as tapered tubes with round ends, the shape that viewers and collision checks want."""

import math
from dataclasses import dataclass

import numpy as np

from canopy_skel.document import SkeletonDocument
from canopy_skel.geometry import BoolArray, FloatArray, IntArray

SIDES = 8
# Ring planes follow the mean direction over at least this much path, so that they turn evenly.
_MIN_WINDOW_M = 0.001
# Rings of each round end beyond the ring of the vertex itself: half way round, and the pole.
_CAP_RINGS = 2


@dataclass(frozen=True, kw_only=True, eq=False, slots=True)
class Tubes:
    """The tubes of all branches, ring after ring, branch after branch.

    position, normal: (R, SIDES, 3), base frame. radius_m: (R,) of the tube at each ring. vertex:
    (R,) the document's vertex a ring stands for. first_ring: (B + 1,) where each branch starts.
    """

    position: FloatArray
    normal: FloatArray
    radius_m: FloatArray
    vertex: IntArray
    first_ring: IntArray

    def triangles(self, branch: int) -> IntArray:
        """Return (T, 3) indices into this branch's ring points (ring * SIDES + side), outward."""
        rings = int(self.first_ring[branch + 1] - self.first_ring[branch])
        ring, side = np.meshgrid(np.arange(rings - 1), np.arange(SIDES), indexing="ij")
        a, c = ring * SIDES + side, (ring + 1) * SIDES + side
        b, d = ring * SIDES + (side + 1) % SIDES, (ring + 1) * SIDES + (side + 1) % SIDES
        near, far = np.stack([a, b, d], axis=-1), np.stack([a, d, c], axis=-1)
        # At the poles all points of the ring are one: there one triangle of two has no area.
        return np.concatenate([near[1:].reshape(-1, 3), far[:-1].reshape(-1, 3)])


def build_tubes(document: SkeletonDocument) -> Tubes:
    """Sweep an eight-sided ring along every branch of a document that has branches.

    A side branch starts on its parent's centre line with its own radius, so that it comes out
    of the parent's surface without a cone; frames are parallel transported, so tubes do not
    twist.
    """
    count = np.array([len(branch.vertices) for branch in document.branches])
    first = np.concatenate([[0], np.cumsum(count)])
    vertex = np.concatenate([branch.vertices for branch in document.branches])
    centre = document.position[vertex]
    radius_m = start_radius_m(document)
    tangent, slope = _directions(centre, radius_m, first)
    side = _transported(tangent, first)

    # Every point of a path is one ring, its ends are three.
    repeats = np.ones(len(vertex), dtype=np.int64)
    repeats[first[:-1]] += _CAP_RINGS
    repeats[first[1:] - 1] += _CAP_RINGS
    point = np.repeat(np.arange(len(vertex)), repeats)
    first_ring = first + 2 * _CAP_RINGS * np.arange(len(first))
    latitude = np.zeros(len(point))
    for ring in range(_CAP_RINGS):
        angle = math.pi / 2 * (1 - ring / _CAP_RINGS)
        latitude[first_ring[:-1] + ring] = -angle
        latitude[first_ring[1:] - 1 - ring] = angle

    turn = 2 * math.pi * np.arange(SIDES) / SIDES
    across = np.cross(tangent, side)
    out = np.cos(turn)[:, None] * side[:, None] + np.sin(turn)[:, None] * across[:, None]
    out, along, ring_radius_m = out[point], tangent[point][:, None], radius_m[point]
    cosine, sine = np.cos(latitude)[:, None, None], np.sin(latitude)[:, None, None]
    on_sphere = cosine * out + sine * along
    lean = np.where(latitude == 0, slope[point], 0.0)[:, None, None]
    return Tubes(
        position=centre[point][:, None] + ring_radius_m[:, None, None] * on_sphere,
        normal=(on_sphere - lean * along) / np.sqrt(1 + lean**2),
        radius_m=ring_radius_m,
        vertex=vertex[point],
        first_ring=first_ring,
    )


def start_radius_m(document: SkeletonDocument) -> FloatArray:
    """Return the radius at each vertex of each branch, branch after branch.

    At a branch's first vertex, which is its parent's, it is at most that of its second.
    """
    radii = []
    for branch in document.branches:
        radius_m = document.radius[list(branch.vertices)]
        if branch.parent is not None:
            radius_m[0] = min(radius_m[0], radius_m[1])
        radii.append(radius_m)
    return np.concatenate(radii)


def _directions(
    centre: FloatArray, radius_m: FloatArray, first: IntArray
) -> tuple[FloatArray, FloatArray]:
    """Return unit tangents (P, 3), zero where a path has no length, and dr/ds (P,)."""
    step_m = np.linalg.norm(np.diff(centre, axis=0), axis=1)
    # One metre between branches keeps them apart on the common arc length.
    step_m[first[1:-1] - 1] = 1.0
    arc_m = np.concatenate([[0.0], np.cumsum(step_m)])
    branch = np.repeat(np.arange(len(first) - 1), np.diff(first))
    window_m = np.maximum(2 * radius_m, _MIN_WINDOW_M)
    low = np.maximum(arc_m - window_m, arc_m[first[:-1]][branch])
    high = np.minimum(arc_m + window_m, arc_m[first[1:] - 1][branch])
    chord = np.stack(
        [np.interp(high, arc_m, axis) - np.interp(low, arc_m, axis) for axis in centre.T], axis=1
    )
    length_m = np.linalg.norm(chord, axis=1)
    taper_m = np.interp(high, arc_m, radius_m) - np.interp(low, arc_m, radius_m)
    run_m = high - low
    slope = np.divide(taper_m, run_m, out=np.zeros_like(run_m), where=run_m > 0)
    some = length_m > 1e-9
    tangent = np.divide(chord, length_m[:, None], out=np.zeros_like(chord), where=some[:, None])
    return _filled(tangent, some, first), np.clip(slope, -1.0, 1.0)


def _filled(tangent: FloatArray, some: BoolArray, first: IntArray) -> FloatArray:
    """Give points without a direction that of the last point that has one; up, if none has."""
    starts = set(first.tolist())
    for missing in np.flatnonzero(~some).tolist():
        tangent[missing] = (0, 0, 1) if missing in starts else tangent[missing - 1]
    return tangent


def _transported(tangent: FloatArray, first: IntArray) -> FloatArray:
    """Return for each point a unit vector across its tangent that turns as little as possible."""
    starts = set(first.tolist())
    side = (1.0, 0.0, 0.0)
    sides = []
    for i, (tx, ty, tz) in enumerate(tangent.tolist()):
        if i in starts:
            side = (0.0, -tz, ty) if abs(tx) < 0.7 else (tz, 0.0, -tx)
        x, y, z = side
        along = x * tx + y * ty + z * tz
        x, y, z = x - along * tx, y - along * ty, z - along * tz
        norm = math.sqrt(x * x + y * y + z * z)
        if norm < 1e-6:
            x, y, z = (0.0, -tz, ty) if abs(tx) < 0.7 else (tz, 0.0, -tx)
            norm = math.sqrt(x * x + y * y + z * z)
        side = (x / norm, y / norm, z / norm)
        sides.append(side)
    return np.array(sides)
