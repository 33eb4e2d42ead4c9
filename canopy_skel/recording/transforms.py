"""Poses between frames at a time, from the transforms a recording carries."""

from bisect import bisect_left, bisect_right
from collections import deque
from collections.abc import Iterable
from dataclasses import replace
from itertools import pairwise

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from canopy_skel.geometry import FloatArray, invert, rotation_from_quaternion, transform_from
from canopy_skel.messages import StampedTransform

_Edge = tuple[str, str]  # parent, child


class TransformBuffer:
    """The transforms of a recording as a graph of frames.

    An edge is either rigid, so that the latest value at or before the asked time holds (else the
    first one): published as static, or mounted on the tool. Or it moves: then only a value at
    exactly the asked time holds, or the interpolation of two neighbours not further apart than
    `max_gap_ns`.
    """

    def __init__(
        self,
        moving: Iterable[StampedTransform],
        static: Iterable[StampedTransform] = (),
        *,
        tool_frame: str,
        max_gap_ns: int,
    ) -> None:
        self._samples: dict[_Edge, list[StampedTransform]] = {}
        self._static: set[_Edge] = set()
        self._tool_frame = tool_frame
        self._max_gap_ns = max_gap_ns
        for transform in moving:
            self._samples.setdefault((transform.parent, transform.child), []).append(transform)
        for transform in static:
            edge = (transform.parent, transform.child)
            self._samples.setdefault(edge, []).append(transform)
            self._static.add(edge)
        for samples in self._samples.values():
            samples.sort(key=_stamp)

    def lookup(self, target: str, source: str, stamp_ns: int) -> FloatArray:
        """Return target_from_source, (4, 4), at a time.

        Raises:
            ValueError: no chain of transforms, no value near enough in time, or a rotation or
                translation that is none.
        """
        target_from_frame = np.eye(4)
        path = self._path(target, source)
        on_tool = target == self._tool_frame
        for here, there in pairwise(path):
            on_tool = on_tool or here == self._tool_frame
            target_from_frame = target_from_frame @ self._step(here, there, stamp_ns, on_tool)
        return target_from_frame

    def around(self, stamp_ns: int) -> list[StampedTransform]:
        """Return the transforms that a lookup at a time goes by: of each edge those next to it.

        Of an edge published as static the value of that time, so that it holds without the role.
        """
        return [
            replace(one, stamp_ns=stamp_ns) if edge in self._static else one
            for edge, samples in self._samples.items()
            for one in self._next_to(edge, samples, stamp_ns)
        ]

    def _next_to(
        self, edge: _Edge, samples: list[StampedTransform], stamp_ns: int
    ) -> list[StampedTransform]:
        after = bisect_left(samples, stamp_ns, key=_stamp)
        latest = max(bisect_right(samples, stamp_ns, key=_stamp) - 1, 0)
        if edge in self._static:
            return [samples[latest]]
        return [samples[i] for i in sorted({latest, min(after, len(samples) - 1)})]

    def _path(self, target: str, source: str) -> list[str]:
        """Return the frames of the shortest chain from target to source."""
        neighbours: dict[str, list[str]] = {}
        for parent, child in self._samples:
            neighbours.setdefault(parent, []).append(child)
            neighbours.setdefault(child, []).append(parent)
        came_from = {target: target}
        queue = deque([target])
        while queue and source not in came_from:
            here = queue.popleft()
            for there in neighbours.get(here, ()):
                if there not in came_from:
                    came_from[there] = here
                    queue.append(there)
        if source not in came_from:
            known = ", ".join(sorted(neighbours)) or "none"
            raise ValueError(
                f"no chain of transforms from {target!r} to {source!r} (frames there: {known});"
                " record the arm pose and the hand-eye calibration, or name the base frame"
            )
        path = [source]
        while path[-1] != target:
            path.append(came_from[path[-1]])
        return path[::-1]

    def _step(self, here: str, there: str, stamp_ns: int, on_tool: bool) -> FloatArray:
        """Return here_from_there over one edge, in whichever direction it was published."""
        edge = (here, there) if (here, there) in self._samples else (there, here)
        samples = self._samples[edge]
        if on_tool or edge in self._static:
            latest = max(bisect_right(samples, stamp_ns, key=_stamp) - 1, 0)
            parent_from_child = _matrix(samples[latest])
        else:
            parent_from_child = self._moving(samples, stamp_ns)
        return parent_from_child if edge == (here, there) else invert(parent_from_child)

    def _moving(self, samples: list[StampedTransform], stamp_ns: int) -> FloatArray:
        after = bisect_left(samples, stamp_ns, key=_stamp)
        if after < len(samples) and samples[after].stamp_ns == stamp_ns:
            return _matrix(samples[after])
        if 0 < after < len(samples):
            before, behind = samples[after - 1], samples[after]
            if behind.stamp_ns - before.stamp_ns <= self._max_gap_ns:
                return _interpolate(before, behind, stamp_ns)
        nearest_ns = min(abs(sample.stamp_ns - stamp_ns) for sample in samples)
        raise ValueError(
            f"no pose {samples[0].parent} -> {samples[0].child} at the exposure (the nearest is"
            f" {nearest_ns / 1e6:.1f} ms away, and there are no two neighbours within"
            f" {self._max_gap_ns / 1e6:.0f} ms); record the pose at each exposure"
        )


def _stamp(transform: StampedTransform) -> int:
    return transform.stamp_ns


def _matrix(transform: StampedTransform) -> FloatArray:
    try:
        rotation = rotation_from_quaternion(transform.quaternion_xyzw)
    except ValueError as error:
        raise ValueError(
            f"{transform.parent} -> {transform.child}: {error}; publish a finite quaternion"
            " (x, y, z, w) of length 1"
        ) from error
    if not np.isfinite(transform.translation_m).all():
        raise ValueError(
            f"{transform.parent} -> {transform.child}: translation"
            f" {list(transform.translation_m)} is not finite; publish it in metres"
        )
    return transform_from(rotation, transform.translation_m)


def _interpolate(before: StampedTransform, behind: StampedTransform, stamp_ns: int) -> FloatArray:
    """Return the pose between two: rotation along the shortest arc, translation straight."""
    share = (stamp_ns - before.stamp_ns) / (behind.stamp_ns - before.stamp_ns)
    first, last = _matrix(before), _matrix(behind)
    arc = Slerp([0.0, 1.0], Rotation.from_matrix(np.stack([first[:3, :3], last[:3, :3]])))
    translation_m = (1 - share) * first[:3, 3] + share * last[:3, 3]
    return transform_from(arc(share).as_matrix(), translation_m)
