"""Each stage from scratch on 70 views: the obvious way, ours, the ratio, a floor."""

import numpy as np
from parts import obvious
from parts.common import (
    CONFIG,
    Engine,
    clusters_of_views,
    least_ms,
    picture,
    segments_of_views,
    table,
    timed,
    together,
)
from scipy.sparse.csgraph import dijkstra

from canopy_skel.cluster import cluster_branches
from canopy_skel.initial import consolidate, spanning_forest
from canopy_skel.pathsearch import PathSearch
from canopy_skel.spline import fit_splines
from canopy_skel.strands import StrandMap, sample_segments
from canopy_skel.voxels import VoxelIndex, voxels_of

FRAGMENTS, INSTANCES = 45, 25
HEAD = ("stage", "obvious ms", "ours ms", "ratio", "floor ms", "floor is")


def report(quick, _output, kept):
    texts, facts = [], {}
    for voxel_mm in (10, 5) if quick else (10, 5, 2.5):
        views = 20 if quick else 70
        name = f"stages-{voxel_mm}mm-{views}"
        text, rows = kept(name, lambda mm=voxel_mm, n=views: at_voxel_size(mm / 1000, n))
        texts.append(text)
        for name, slow, fast, *_ in rows:
            facts[name.split(",")[0], voxel_mm] = slow / fast
    return "\n".join(texts), facts


def at_voxel_size(voxel_m, views):
    clusters = clusters_of_views(FRAGMENTS, views)
    segments = segments_of_views(FRAGMENTS, views)
    engine = Engine(voxel_m)
    for one in segments:
        engine.add(one)
    rows = [clustering(), least_squares(clusters[0]), map_update(segments[:3], voxel_m)]
    rows += skeleton_stages(engine, segments, voxel_m)
    rows += search_stages(engine)
    held_mb = (engine.map.nbytes + engine.search.nbytes) / 2**20
    title = (
        f"{1000 * voxel_m:g} mm: {views} views, {engine.map.occupied()} voxels in"
        f" {engine.map.blocks.count} blocks"
    )
    return table(title, HEAD, rows) + f"\nMap and search hold {held_mb:.0f} MB.\n", rows


def row(name, slow, fast, floor, what):
    return (name, slow, fast, f"{slow / fast:.1f} x", floor, what)


def clustering():
    view, masks = picture(INSTANCES)
    pixels = sum(int(mask.mask.sum()) for mask in masks)
    depth_m = view.depth_m.ravel()[:pixels].copy()
    return row(
        f"clusters, {len(masks)} masks",
        least_ms(lambda: obvious.clusters(view, masks)),
        least_ms(lambda: cluster_branches(view, masks, CONFIG.cluster), 5),
        least_ms(depth_m.sum, 5),
        f"one sum over {pixels} depths, as many as the masks have",
    )


def least_squares(clusters):
    points = np.concatenate([c.points_in_base for c in clusters])
    return row(
        f"least squares, {len(clusters)} clusters",
        least_ms(lambda: obvious.splines(clusters)),
        least_ms(lambda: fit_splines(clusters, CONFIG.spline), 5),
        *summed(points),
    )


def summed(points):
    """Return what three sums over points (N, 3) take, and what that is."""
    columns = np.ascontiguousarray(points.T)
    return least_ms(lambda: [columns.sum(axis=1) for _ in range(3)]), "three sums over all points"


def map_update(segments, voxel_m):
    dense = obvious.DenseMap((-0.5,) * 3, (2.5,) * 3, voxel_m)
    slow = np.median([least_ms(lambda one=one: dense.add(one), 2) for one in segments])
    dense = None
    fast, support = [], []
    for one in segments:
        engine = Engine(voxel_m)
        engine.map.add(one)  # blocks are allocated: as in the middle of a scan
        fast.append(least_ms(lambda engine=engine, one=one: engine.map.add(one), 5))
        support.append(support_of(one, voxel_m))
    return row("map update, one view", slow, np.median(fast), *touched(int(np.median(support))))


def touched(voxels):
    """Return what adding to so many voxels in a row takes, and what that is."""
    sums = np.zeros(voxels, dtype=np.int32)
    return least_ms(
        lambda: sums.__iadd__(1), 5
    ), f"one addition to each of {voxels} voxels in a row"


def support_of(segments, voxel_m):
    """Return how many voxels lie in the ellipsoids of segments, counted as often as they do."""
    length = np.linalg.norm(segments.ends_in_base - segments.starts_in_base, axis=1) / voxel_m
    radius = segments.radius_m / voxel_m
    return int((45 * np.pi * radius**2 * length).sum())


def skeleton_stages(engine, segments, voxel_m):
    points = sample_segments(together(segments), 0.5 * voxel_m)[0]

    def fresh():
        strands = StrandMap(voxel_m, CONFIG.initial.smoothing)
        for one in segments:
            strands.add(one)
        return strands

    strands = [fresh() for _ in range(2)]
    moved, slow = timed(lambda: obvious.smoothed(points))
    ours_ms = min(timed(s.smoothed)[1] for s in strands)
    rows = [row("smoothing, 3 steps", slow, ours_ms, *summed(points))]
    smoothed = engine.strands.smoothed()

    def ours():
        vertices, _ = consolidate(smoothed, voxel_m)
        spanning_forest(vertices, voxel_m)

    slow = timed(lambda: obvious.forest(moved, voxel_m))[1]
    keys = voxels_of(smoothed.points_in_base, voxel_m)[:, 0]
    floor = least_ms(lambda: np.sort(keys))
    what = "one sort of as many integers as there are points"
    rows.append(row("consolidation and forest", slow, least_ms(ours), floor, what))
    return rows


def scipy_search(engine, initial):
    """Return what building the explicit graph and one Dijkstra on it take."""
    grid = engine.map.grid()
    index = VoxelIndex(grid.voxels)
    graph, build = timed(
        lambda: obvious.explicit_graph(grid.voxels, grid.empty_probability(), index)
    )
    sources = index.find(voxels_of(initial.vertices_in_base, engine.map.voxel_size_m))
    return build, timed(lambda: dijkstra(graph, indices=sources, min_only=True))[1]


def search_stages(engine):
    initial = engine.observed()
    build, single = scipy_search(engine, initial)

    def scratch():
        search = PathSearch(engine.map)
        search.update(initial)
        return search, search.joins()

    (search, joins), ours = min((timed(scratch) for _ in range(2)), key=lambda r: r[1])
    engine.search = search
    pieces = initial.components()[0]
    runs = sum(range(pieces - len(joins), pieces + 1))
    cheapest = f"one such Dijkstra, graph not counted ({build:.0f} ms)"
    return [
        row("Algorithm 1 / one scipy Dijkstra", single, ours, single, cheapest),
        row(
            f"Algorithm 1 / literal, {runs} Dijkstras (extrapolated)",
            runs * single,
            ours,
            single,
            cheapest,
        ),
    ]
