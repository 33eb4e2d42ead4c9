"""What the parts share: input, clocks, tables."""

from functools import cache
from time import thread_time

import numpy as np
from scene import picture_of, sections_of_canopy, views_of

from canopy_skel.initial import initial_skeleton
from canopy_skel.likelihood import LikelihoodConfig, LikelihoodMap, Segments, segments_of
from canopy_skel.pathsearch import PathSearch, add_paths, straighten_predicted
from canopy_skel.pipeline import MethodConfig
from canopy_skel.spline import fit_splines
from canopy_skel.strands import StrandMap

CONFIG = MethodConfig(name="paper")


@cache
def clusters_of_views(fragments, views, instances=25, box_m=2.0, wood_m=66.0):
    """The clusters of each view of a synthetic canopy."""
    sections = sections_of_canopy(fragments, wood_m=wood_m, box_m=box_m)
    return views_of(sections, views=views, instances=instances, box_m=box_m)


@cache
def picture(instances):
    """A view and its masks, for what the clusters of a view cost."""
    return picture_of(instances)


@cache
def segments_of_views(*scene):
    return [segments_of(fit_splines(c, CONFIG.spline)) for c in clusters_of_views(*scene)]


def together(parts):
    names = ("starts_in_base", "ends_in_base", "radius_m", "confidence")
    return Segments(**{n: np.concatenate([getattr(p, n) for p in parts]) for n in names})


class Engine:
    """The method after the clusters, stage by stage as the Skeletonizer runs them."""

    def __init__(self, voxel_size_m):
        self.map = LikelihoodMap(LikelihoodConfig(voxel_size_m=voxel_size_m))
        self.strands = StrandMap(voxel_size_m, CONFIG.initial.smoothing)
        self.search = PathSearch(self.map)

    def add(self, segments):
        self.map.add(segments)
        self.strands.add(segments)

    def observed(self):
        return initial_skeleton(self.strands.smoothed(), self.map, CONFIG.initial)

    def joined(self, initial, joins):
        graph = add_paths(initial, joins, self.map)
        return straighten_predicted(graph, CONFIG.straighten_steps)


def timed(work):
    """Return what a call gives and its milliseconds."""
    start = thread_time()
    result = work()
    return result, 1e3 * (thread_time() - start)


def least_ms(work, repeats=3):
    return min(timed(work)[1] for _ in range(repeats))


def table(title, head, rows):
    lines = [f"## {title}", "", "| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
    lines += ["| " + " | ".join(shown(cell) for cell in row) + " |" for row in rows]
    return "\n".join(lines) + "\n"


def shown(cell):
    if isinstance(cell, float):
        return f"{cell:.0f}" if abs(cell) >= 100 else f"{cell:.3g}"
    return "–" if cell is None else str(cell)
