"""From the skeleton's edges to line segments in an image, cut where the view ends."""

from dataclasses import dataclass

import numpy as np

from canopy_skel.document import SkeletonDocument
from canopy_skel.frame import Intrinsics, View
from canopy_skel.geometry import BoolArray, FloatArray, IntArray, invert, transform_points

NEAR_M = 0.05
# Lines end this far outside the image, so that their ends are not seen.
_MARGIN_PX = 32.0


@dataclass(frozen=True, kw_only=True, eq=False, slots=True)
class Segments:
    """Line segments in pixels, in the order of the branches.

    start_px, end_px: (S, 2). radius_px: (S,) of the wood, as the image shows it. occluded: (S,)
    whether either end of the edge was predicted. run: (S,) same number along one branch as long
    as `occluded` stays the same.
    """

    start_px: FloatArray
    end_px: FloatArray
    radius_px: FloatArray
    occluded: BoolArray
    run: IntArray


def project_edges(view: View, document: SkeletonDocument) -> Segments:
    """Return what a view can show of each edge, behind other things or not."""
    steps = [np.column_stack([b.vertices[:-1], b.vertices[1:]]) for b in document.branches]
    edges = np.concatenate([np.empty((0, 2), dtype=np.int64), *steps])
    branch = np.repeat(np.arange(len(steps)), [len(step) for step in steps])
    occluded = document.occluded[edges].any(axis=1)
    changed = (np.diff(branch) != 0) | (np.diff(occluded) != 0)
    run = np.concatenate([[0], np.cumsum(changed)])[: len(edges)]

    points = transform_points(invert(view.base_from_camera), document.position)
    start, end = points[edges[:, 0]], points[edges[:, 1]]
    seen, start, end = _cut(start, end, view.intrinsics)
    # The outer end's radius: at its first vertex a side branch has its parent's.
    radius_m = document.radius[edges[seen, 1]]
    return Segments(
        start_px=view.intrinsics.project(start),
        end_px=view.intrinsics.project(end),
        radius_px=view.intrinsics.fx_px * radius_m / end[:, 2],
        occluded=occluded[seen],
        run=run[seen],
    )


def dashed(segments: Segments, on_px: float, off_px: float) -> Segments:
    """Cut gaps into the occluded segments, evenly along every run."""
    length_px = np.linalg.norm(segments.end_px - segments.start_px, axis=1)
    total_px = np.cumsum(length_px)
    run_start_px = np.zeros(len(length_px))
    new_run = np.diff(segments.run, prepend=-1) != 0
    run_start_px[new_run] = (total_px - length_px)[new_run]
    begin_px = total_px - length_px - np.maximum.accumulate(run_start_px)
    pieces: list[tuple[int, float, float]] = []
    for i, (begin, length) in enumerate(zip(begin_px.tolist(), length_px.tolist(), strict=True)):
        if not segments.occluded[i]:
            pieces.append((i, 0.0, 1.0))
            continue
        period = on_px + off_px
        dash = begin - begin % period
        while dash < begin + length:
            low, high = max(dash, begin), min(dash + on_px, begin + length)
            if low < high:
                pieces.append((i, (low - begin) / length, (high - begin) / length))
            dash += period
    index = np.array([i for i, _, _ in pieces], dtype=np.int64)
    part = np.array([(low, high) for _, low, high in pieces]).reshape(-1, 2)
    start, along = segments.start_px[index], (segments.end_px - segments.start_px)[index]
    return Segments(
        start_px=start + part[:, :1] * along,
        end_px=start + part[:, 1:] * along,
        radius_px=segments.radius_px[index],
        occluded=segments.occluded[index],
        run=segments.run[index],
    )


def _cut(
    start: FloatArray, end: FloatArray, camera: Intrinsics
) -> tuple[BoolArray, FloatArray, FloatArray]:
    """Cut segments (N, 3) of the camera frame to the near plane and the borders of the image.

    Returns:
        which segments are seen (N,); starts and ends (S, 3) of what is seen of them.
    """
    planes = np.array(
        [
            [0.0, 0.0, 1.0, -NEAR_M],
            [camera.fx_px, 0.0, camera.cx_px + _MARGIN_PX, 0.0],
            [-camera.fx_px, 0.0, camera.width_px + _MARGIN_PX - camera.cx_px, 0.0],
            [0.0, camera.fy_px, camera.cy_px + _MARGIN_PX, 0.0],
            [0.0, -camera.fy_px, camera.height_px + _MARGIN_PX - camera.cy_px, 0.0],
        ]
    )
    inside_start = start @ planes[:, :3].T + planes[:, 3]
    inside_end = end @ planes[:, :3].T + planes[:, 3]
    change = inside_end - inside_start
    crossing = np.divide(-inside_start, change, out=np.zeros_like(change), where=change != 0)
    low = np.where(inside_start < 0, crossing, 0.0).max(axis=1, initial=0.0)
    high = np.where(inside_end < 0, crossing, 1.0).min(axis=1, initial=1.0)
    outside = ((inside_start < 0) & (inside_end < 0)).any(axis=1)
    seen = ~outside & (low <= high)
    step = (end - start)[seen]
    return seen, start[seen] + low[seen, None] * step, start[seen] + high[seen, None] * step
