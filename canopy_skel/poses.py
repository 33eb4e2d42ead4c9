"""Where a view disagrees with all views together, its pose is off: measure it, and mend it."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from canopy_skel.fusion import Observations, Observed
from canopy_skel.geometry import FloatArray, IntArray, transform_from, transform_points
from canopy_skel.kernels import aligning, fuse

_MIN_COSINE = 0.9
_FEWEST_VIEWS, _FEWEST_POINTS, _ALONE, _LEAST_USUAL = 3, 100, 0.5, 0.3
"""Of so many views with so many points, one is alone that has less than half of the usual share of
its wood along others; where less than .3 is usual, that says nothing."""
_FEWEST_TO_FIND, _FOUND, _FARTHEST_M, _MOST_TURNED = 250, 0.8, 0.15, np.radians(8.0)
"""It is found again if it has so many points, then four fifths of the usual share, and no more than
this to go."""
_SEARCH_M, _STEP_M, _SAMPLE, _ALIGNINGS = 0.08, 0.02, 300, 4
"""How far and how finely shifts are tried, on so many points; and how often it is aligned then, as
each time reaches only so far."""


@dataclass(frozen=True, kw_only=True, slots=True)
class PoseConfig:
    """When a view is moved onto the fused skeleton.

    Points within `reach_m` of it and along it count, at least `min_points`. A view is moved only
    if they lie `worst_m` off (median, across the wood) or more, and the move takes that to at most
    `enough` of it: a good rig is left alone.
    """

    reach_m: float = 0.03
    min_points: int = 100
    worst_m: float = 0.0015
    enough: float = 0.7
    rounds: int = 3


@dataclass(frozen=True, kw_only=True, eq=False, slots=True)
class PoseCorrection:
    """A view that was moved: its place among those that are in, and by what.

    moved: (4, 4), maps points of the view as reported to where they belong, in base. before_m,
    after_m: median distance of its wood from the fused skeleton, across it. brought_back: it was
    too far off for that (see `found_again`); before_m is how far its wood was moved, on the mean.
    """

    view: int
    moved: FloatArray
    before_m: float
    after_m: float
    brought_back: bool = False


@dataclass(frozen=True, kw_only=True, slots=True)
class LoneView:
    """A view that hardly any other agrees with: its place among those that are in.

    along: share of its instances' wood along which others show any. usual: the median of all views.
    """

    view: int
    along: float
    usual: float


def lone_views(along: FloatArray, points: IntArray) -> list[LoneView]:
    """Return the views that are probably centimetres off, too far to be aligned with the others.

    Beyond some 25 mm the wood of such a view is a forest of its own, which it fits perfectly.
    along, points: (V,), see `LoneView`, and of how many points that is the share.
    """
    enough = points >= _FEWEST_POINTS
    if np.count_nonzero(enough) < _FEWEST_VIEWS:
        return []
    usual = float(np.median(along[enough]))
    if usual < _LEAST_USUAL:  # None agrees with any other.
        return []
    alone = np.flatnonzero(enough & (along < _ALONE * usual))
    return [LoneView(view=i, along=float(along[i]), usual=usual) for i in alone.tolist()]


def pose_corrections(
    seen: Observations, fused: Observed, config: PoseConfig
) -> list[PoseCorrection]:
    """Return how the views that disagree with the fused skeleton have to be moved.

    What is common to all views, such as a wrong hand-eye calibration, cannot be seen here.
    """
    if len(fused.vertices_in_base) == 0:
        return []
    lines = _lines(fused, config.reach_m)
    found = []
    for view in np.unique(seen.view).tolist():
        chosen = np.flatnonzero((seen.view == view) & ~seen.fragment)
        if len(chosen) < config.min_points:
            continue
        points, directions = seen.points_in_base[chosen], seen.directions[chosen]
        moved, before_m, after_m = _aligned(points, directions, lines, config)
        if before_m >= config.worst_m and after_m <= config.enough * before_m:
            found.append(PoseCorrection(view=view, moved=moved, before_m=before_m, after_m=after_m))
    return found


def found_again(
    view: int, points: FloatArray, directions: FloatArray, others: Observed, config: PoseConfig
) -> PoseCorrection | None:
    """Return the rigid motion that takes a lone view's wood onto what other views show.

    points, directions: (N, 3), of its instances. others: fused without it. Shifts of up to 8 cm
    along each axis are tried, the least of those first that as many points agree with; from the
    best of them the view is aligned as others are. None where that fails, or ends farther off than
    a rig is ever knocked (15 cm, 8 degrees), or where there is so little wood that it fits in many
    places.
    """
    if len(points) < _FEWEST_TO_FIND or len(others.vertices_in_base) == 0:
        return None
    fine, coarse = _lines(others, _STEP_M), _lines(others, config.reach_m)
    some = np.linspace(0, len(points) - 1, min(len(points), _SAMPLE)).astype(np.int64)
    steps = np.arange(-_SEARCH_M, _SEARCH_M + _STEP_M / 2, _STEP_M)
    shifts = np.stack(np.meshgrid(steps, steps, steps), axis=-1).reshape(-1, 3)
    shifts = shifts[np.argsort(np.linalg.norm(shifts, axis=1), kind="stable")]
    fits = [len(_near(points[some] + shift, directions[some], fine)[0]) for shift in shifts]
    moved, after_m = np.eye(4), np.inf
    moved[:3, 3] = shifts[int(np.argmax(fits))]
    for _ in range(_ALIGNINGS):
        here, ways = transform_points(moved, points), directions @ moved[:3, :3].T
        closer, _, after_m = _aligned(here, ways, coarse, config)
        moved = closer @ moved
    way_m = float(np.linalg.norm(transform_points(moved, points) - points, axis=1).mean())
    turned = np.linalg.norm(Rotation.from_matrix(moved[:3, :3]).as_rotvec())
    if not np.isfinite(after_m) or way_m > _FARTHEST_M or turned > _MOST_TURNED:
        return None
    return PoseCorrection(
        view=view, moved=moved, before_m=way_m, after_m=after_m, brought_back=True
    )


def is_found(view: LoneView, along: float) -> bool:
    """Say whether a lone view lies along the others as views do, now that it was moved."""
    return along >= _FOUND * view.usual


def one_after_other(
    first: Sequence[PoseCorrection], then: Sequence[PoseCorrection]
) -> list[PoseCorrection]:
    """Return corrections as one per view, of views that were moved and then moved again."""
    both = {one.view: one for one in first}
    for one in then:
        before = both.get(one.view)
        both[one.view] = one
        if before is not None:
            both[one.view] = PoseCorrection(
                view=one.view,
                moved=one.moved @ before.moved,
                before_m=before.before_m,
                after_m=one.after_m,
                brought_back=True,
            )
    return [both[view] for view in sorted(both)]


def corrected(seen: Observations, corrections: list[PoseCorrection]) -> FloatArray:
    """Return the positions (N, 3) of the points with the views moved."""
    points = seen.points_in_base.copy()
    for one in corrections:
        chosen = seen.view == one.view
        points[chosen] = transform_points(one.moved, points[chosen])
    return points


@dataclass(frozen=True, kw_only=True, eq=False, slots=True)
class _Lines:
    """Vertices (V, 3) of the fused skeleton and their directions, by the keys of their cells."""

    points: FloatArray
    directions: FloatArray
    keys: IntArray
    cell_m: float


def _lines(fused: Observed, cell_m: float) -> _Lines:
    keys = fuse.cell_keys(fused.vertices_in_base, cell_m)
    order = np.argsort(keys, kind="stable")
    return _Lines(
        points=fused.vertices_in_base[order],
        directions=fused.directions[order],
        keys=keys[order],
        cell_m=cell_m,
    )


def _near(
    points: FloatArray, directions: FloatArray, lines: _Lines
) -> tuple[IntArray, IntArray, FloatArray]:
    """Return which points lie along a vertex within the cells' size; see `aligning.offsets`."""
    return aligning.offsets(
        points,
        np.ascontiguousarray(directions),
        lines.points,
        lines.directions,
        lines.keys,
        lines.cell_m,
        _MIN_COSINE,
    )


def _aligned(
    points: FloatArray, directions: FloatArray, lines: _Lines, config: PoseConfig
) -> tuple[FloatArray, float, float]:
    """Return the transform and the median distance across the wood before and after it.

    A view that lies well enough stays as it is.
    """
    moved, here = np.eye(4), points
    before_m = after_m = 0.0
    for step in range(config.rounds + 1):
        near, index, off = _near(here, directions, lines)
        if len(near) < config.min_points:
            return np.eye(4), before_m, np.inf
        off_m = np.linalg.norm(off, axis=1)
        after_m = float(np.median(off_m))
        before_m = after_m if step == 0 else before_m
        if before_m < config.worst_m:
            break
        if step < config.rounds:
            weight = 1.0 / np.maximum(off_m, max(after_m, 1e-6))
            moved = _small_move(here[near], off, lines.directions[index], weight) @ moved
            here = transform_points(moved, points)
    return moved, before_m, after_m


def _small_move(
    points: FloatArray, off: FloatArray, directions: FloatArray, weight: FloatArray
) -> FloatArray:
    """Return the rigid motion that takes most of `off` away: one robust Gauss-Newton step."""
    centre = points.mean(axis=0)
    equations = aligning.normal_equations(points - centre, off, directions, weight)
    normal, right = equations[:, :6], equations[:, 6]
    step = np.linalg.solve(normal + 1e-9 * np.trace(normal) * np.eye(6), right)
    rotation = Rotation.from_rotvec(step[3:]).as_matrix()
    return transform_from(rotation, centre + step[:3] - rotation @ centre)
