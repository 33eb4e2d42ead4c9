"""The obvious way to do each stage: numpy and scipy, one call after the other."""

import numpy as np
from scipy.interpolate import make_lsq_spline
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components, minimum_spanning_tree
from scipy.spatial import cKDTree

from canopy_skel.cluster import principal_axes


def clusters(view, masks, within_m=0.01, neighbours=20):
    """Outliers off by their neighbours' distances, then what lies within 1 cm, mask by mask."""
    found = []
    for mask in masks:
        v, u = np.nonzero(mask.mask)
        v, u = v + mask.top_px, u + mask.left_px
        points = view.intrinsics.back_project(
            *(a.astype(float) for a in (u, v, view.depth_m[v, u]))
        )
        away = cKDTree(points).query(points, k=neighbours)[0].mean(axis=1)
        points = points[away <= away.mean() + away.std()]
        pairs = cKDTree(points).query_pairs(within_m, output_type="ndarray")
        links = coo_array((np.ones(len(pairs)), pairs.T), shape=(len(points),) * 2)
        count, part = connected_components(links, directed=False)
        found += [points[part == k] for k in range(count)]
        for one in found[-count:]:
            principal_axes(one)  # is it slender?
    return found


def splines(clusters):
    """The library's least squares and the paper's radius, one cluster after the other."""
    for cluster in clusters:
        points = cluster.points_in_base
        along = (points - points.mean(axis=0)) @ principal_axes(points)[1][0]
        order = np.argsort(along)
        knots = np.linspace(along.min(), along.max(), 4)
        make_lsq_spline(along[order], points[order], np.r_[knots[0], knots, knots[-1]], k=1)
        np.ptp(points @ principal_axes(points)[1][1])  # the radius


class DenseMap:
    """Numpy over the bounding box of each segment's support, into one dense array."""

    def __init__(self, low_m, high_m, voxel_size_m):
        self.voxel_size_m = voxel_size_m
        self.origin = np.floor(np.asarray(low_m) / voxel_size_m).astype(int)
        shape = np.ceil(np.asarray(high_m) / voxel_size_m).astype(int) - self.origin
        self.p = np.zeros(shape, dtype=np.float32)  # takes memory where it is written only

    def add(self, segments, k=3.0):
        voxel = self.voxel_size_m
        starts, ends = segments.starts_in_base / voxel, segments.ends_in_base / voxel
        length = np.linalg.norm(ends - starts, axis=1)
        axes, radii = (ends - starts) / length[:, None], segments.radius_m / voxel
        tips = np.stack([starts - k * length[:, None] * axes, ends + k * length[:, None] * axes])
        low = np.floor(tips.min(axis=0) - k * radii[:, None]).astype(int)
        high = np.ceil(tips.max(axis=0) + k * radii[:, None]).astype(int) + 1
        low = np.maximum(low, self.origin)
        high = np.minimum(high, self.origin + self.p.shape)
        for i in range(len(starts)):
            if (low[i] >= high[i]).any():
                continue
            grids = np.ogrid[tuple(slice(a, b) for a, b in zip(low[i], high[i], strict=True))]
            w = [g + 0.5 - s for g, s in zip(grids, starts[i], strict=True)]
            along = sum(a * x for a, x in zip(axes[i], w, strict=True))
            across = np.sqrt(np.maximum(sum(x * x for x in w) - along**2, 0.0))
            outside = np.maximum(np.maximum(-along, along - length[i]), 0.0)
            s = np.sqrt((outside / length[i]) ** 2 + (across / radii[i]) ** 2)
            p = np.maximum(segments.confidence[i] * (1 - s / k), 0.0)
            corners = zip(low[i] - self.origin, high[i] - self.origin, strict=True)
            box = self.p[tuple(slice(a, b) for a, b in corners)]
            box += p * (1 - box)


def smoothed(points, steps=3):
    for _ in range(steps):
        _, near = cKDTree(points).query(points, k=8)
        points = points[near].mean(axis=1)
    return points


def forest(points, voxel_size_m):
    """kd-tree pairs and the library's spanning tree over all points."""
    pairs = cKDTree(points).query_pairs(np.sqrt(3) * voxel_size_m, output_type="ndarray")
    length = np.linalg.norm(points[pairs[:, 0]] - points[pairs[:, 1]], axis=1)
    weights = coo_array((np.maximum(length, 1e-12), pairs.T), shape=(len(points),) * 2)
    return minimum_spanning_tree(weights.tocsr())


def explicit_graph(voxels, q, index):
    """The likelihood graph with every edge written out, which the libraries need."""
    rows, columns = [], []
    for offset in [o for o in np.ndindex(3, 3, 3) if o > (1, 1, 1)]:
        other = index.find((voxels + np.array(offset) - 1).astype(np.int32))
        rows.append(np.flatnonzero(other >= 0))
        columns.append(other[other >= 0])
    u, v = np.concatenate(rows), np.concatenate(columns)
    weight = np.maximum(-np.log1p(-0.5 * (q[u] + q[v])), 1e-6)
    both = coo_array((np.tile(weight, 2), (np.append(u, v), np.append(v, u))), shape=(len(q),) * 2)
    return both.tocsr()
