"""Time each stage beside the obvious way to do it, in one run on the same input.

    python benchmarks/stages.py [RECORDING]

Prints median milliseconds of the thread's CPU time and the ratio; the machine's speed cancels out.

Two rows do not compare the same work: smoothing here compares directions, which the nearest
neighbours of the obvious way do not, and all of Algorithm 1 stands beside a single search.
"""

import sys
from pathlib import Path
from time import thread_time

import numpy as np
from scipy.interpolate import make_lsq_spline
from scipy.sparse import coo_array
from scipy.sparse.csgraph import dijkstra, minimum_spanning_tree
from scipy.spatial import cKDTree

from canopy_skel.cluster import cluster_branches, principal_axes
from canopy_skel.initial import initial_skeleton, sample_segments
from canopy_skel.likelihood import LikelihoodMap, VoxelIndex, segments_of, voxels_of
from canopy_skel.pathsearch import search_paths
from canopy_skel.pipeline import MethodConfig
from canopy_skel.recording import read_recording
from canopy_skel.segmenters.recorded import RecordedSegmenter
from canopy_skel.spline import fit_spline

DEMO = Path(__file__).parents[1] / "recordings/demo_apple.mcap"
REPEATS = 5


def main():
    path = Path(sys.argv[1]) if len(sys.argv) > 1 else DEMO
    config = MethodConfig()
    views = list(read_recording(path).views())
    segmenter = RecordedSegmenter()
    clusters = [
        c
        for view in views
        for c in cluster_branches(view, segmenter.segment(view), config.cluster)[0]
    ]
    segments = segments_of([fit_spline(c, config.spline) for c in clusters])

    def update():
        likelihood = LikelihoodMap(config.likelihood)
        likelihood.add(segments)
        return likelihood.grid()

    grid = update()
    index = VoxelIndex(grid.voxels)
    skeleton = initial_skeleton(segments, grid, index, config.initial)
    search_paths(skeleton, grid, index)
    print(f"{path.name}: {len(clusters)} clusters, {len(grid.voxels)} voxels", end="")
    print(f", {skeleton.components()[0]} pieces; median of {REPEATS} runs")
    print(f"{'stage':30} {'obvious ms':>12} {'ours ms':>12} {'ratio':>8}")
    row("least squares", lambda: library_splines(clusters), lambda: splines(clusters, config))
    row("map update", lambda: boxes(segments, config.likelihood), update)
    row(
        "smooth, consolidate, forest",
        lambda: library_forest(segments, grid.voxel_size_m),
        lambda: initial_skeleton(segments, grid, index, config.initial),
    )
    graph = explicit_graph(grid, index)
    sources = index.find(voxels_of(skeleton.vertices_in_base, grid.voxel_size_m))
    row(
        "Algorithm 1 / one Dijkstra",
        lambda: dijkstra(graph, directed=False, indices=sources, min_only=True),
        lambda: search_paths(skeleton, grid, index),
    )


def row(name, obvious, ours):
    slow, fast = median_ms(obvious), median_ms(ours)
    print(f"{name:30} {slow:12.1f} {fast:12.1f} {slow / fast:8.2f}")


def median_ms(work):
    times = []
    for _ in range(REPEATS):
        start = thread_time()
        work()
        times.append(1e3 * (thread_time() - start))
    return float(np.median(times))


def splines(clusters, config):
    return [fit_spline(cluster, config.spline) for cluster in clusters]


def library_splines(clusters):
    for cluster in clusters:
        points = cluster.points_in_base
        along = (points - points.mean(axis=0)) @ principal_axes(points)[1][0]
        order = np.argsort(along)
        knots = np.quantile(along, np.linspace(0, 1, 4))
        make_lsq_spline(along[order], points[order], np.r_[knots[0], knots, knots[-1]], k=1)


def boxes(segments, config):
    """Numpy over the bounding box of each segment's support, into one dense array."""
    voxel, k = config.voxel_size_m, config.k
    starts, ends = segments.starts_in_base / voxel, segments.ends_in_base / voxel
    length = np.linalg.norm(ends - starts, axis=1)
    axes, radii = (ends - starts) / length[:, None], segments.radius_m / voxel
    tips = np.stack([starts - k * length[:, None] * axes, ends + k * length[:, None] * axes])
    low = np.floor(tips.min(axis=0) - k * radii[:, None]).astype(int)
    high = np.ceil(tips.max(axis=0) + k * radii[:, None]).astype(int) + 1
    origin = low.min(axis=0)
    q = np.ones(high.max(axis=0) - origin, dtype=np.float32)
    for i in range(len(starts)):
        grids = np.ogrid[tuple(slice(a, b) for a, b in zip(low[i], high[i], strict=True))]
        w = [g + 0.5 - s for g, s in zip(grids, starts[i], strict=True)]
        along = sum(a * x for a, x in zip(axes[i], w, strict=True))
        across = np.sqrt(np.maximum(sum(x * x for x in w) - along**2, 0.0))
        outside = np.maximum(np.maximum(-along, along - length[i]), 0.0)
        s = np.sqrt((outside / length[i]) ** 2 + (across / radii[i]) ** 2)
        p = np.maximum(segments.confidence[i] * (1 - s / k), 0.0)
        box = tuple(slice(a - o, b - o) for a, b, o in zip(low[i], high[i], origin, strict=True))
        q[box] *= 1 - p
    return q


def library_forest(segments, voxel_size_m):
    """Nearest neighbours of all samples three times, then the spanning tree of all of them."""
    points = sample_segments(segments, 0.5 * voxel_size_m).points_in_base
    for _ in range(3):
        _, near = cKDTree(points).query(points, k=8)
        points = points[near].mean(axis=1)
    pairs = cKDTree(points).query_pairs(np.sqrt(3) * voxel_size_m, output_type="ndarray")
    length = np.linalg.norm(points[pairs[:, 0]] - points[pairs[:, 1]], axis=1)
    weights = coo_array((np.maximum(length, 1e-12), pairs.T), shape=(len(points),) * 2)
    return minimum_spanning_tree(weights.tocsr())


def explicit_graph(grid, index):
    """The likelihood graph with every edge written out, which the libraries need."""
    q = grid.empty_probability()
    rows, columns = [], []
    offsets = [o for o in np.ndindex(3, 3, 3) if o > (1, 1, 1)]
    for offset in offsets:
        other = index.find((grid.voxels + np.array(offset) - 1).astype(np.int32))
        rows.append(np.flatnonzero(other >= 0))
        columns.append(other[other >= 0])
    u, v = np.concatenate(rows), np.concatenate(columns)
    weight = np.maximum(-np.log1p(-0.5 * (q[u] + q[v])), 1e-6)
    return coo_array((weight, (u, v)), shape=(len(q), len(q))).tocsr()


if __name__ == "__main__":
    main()
