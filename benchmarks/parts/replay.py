"""A whole replay from masks to skeleton, against the obvious stack on the same clusters."""

from pathlib import Path

import numpy as np
from parts import obvious
from parts.common import CONFIG, Engine, table, timed, together
from scipy.sparse.csgraph import dijkstra

from canopy_skel.cluster import cluster_branches
from canopy_skel.likelihood import segments_of
from canopy_skel.recording import read_recording
from canopy_skel.segmenters.recorded import RecordedSegmenter
from canopy_skel.spline import fit_splines
from canopy_skel.strands import sample_segments
from canopy_skel.voxels import VoxelIndex, voxels_of
from drivers.stereo import with_depth

ROOT = Path(__file__).parents[2]
SHARED = ROOT / "../shared/data/recordings"


def report(quick, _output, kept):
    paths = [ROOT / "recordings/demo_apple.mcap"]
    if not quick:
        paths += [p for name in ("apple_fd2", "oak_fd3") if (p := SHARED / f"{name}.mcap").exists()]
    head = (
        "recording", "views", "voxels", "pieces", "clusters, shared", "obvious ms", "ours ms",
        "ratio", "ours, skeleton after every view",
    )  # fmt: skip
    text = table(
        "Whole replay at 5 mm",
        head,
        [kept(f"replay-{path.stem}", lambda path=path: row_of(path)) for path in paths],
    )
    text += (
        "\nObvious: scipy splines, numpy per bounding box, kd-tree smoothing and forest, explicit"
        " graph, a Dijkstra per piece and round (one timed, the rest extrapolated).\n"
    )
    return text, {}


def row_of(path):
    views = [with_depth(view) for view in read_recording(path).views()]
    segmenter = RecordedSegmenter()

    def lift():
        masks = [segmenter.segment(v) for v in views]
        return [
            cluster_branches(v, m, CONFIG.cluster)[0] for v, m in zip(views, masks, strict=True)
        ]

    clusters, shared = timed(lift)

    def ours(every):
        engine = Engine(0.005)
        for number, one in enumerate(clusters, start=1):
            engine.add(segments_of(fit_splines(one, CONFIG.spline)))
            if every or number == len(clusters):
                initial = engine.observed()
                engine.search.update(initial)
                joins = engine.search.joins()
                engine.joined(initial, joins)
        return engine, initial, joins

    (engine, initial, joins), once = timed(lambda: ours(False))
    _, always = timed(lambda: ours(True))
    slow = obvious_ms(clusters, engine, initial, joins)
    return (
        path.stem, len(views), engine.map.occupied(), initial.components()[0], shared, slow, once,
        f"{slow / once:.0f} x", always,
    )  # fmt: skip


def obvious_ms(clusters, engine, initial, joins):
    """The stages as the obvious stack does them, with our skeleton's voxels as sources."""
    total = timed(lambda: [obvious.splines(one) for one in clusters])[1]
    segments = [segments_of(fit_splines(one, CONFIG.spline)) for one in clusters]
    everything = together(segments)
    grid = engine.map.grid()
    low, high = grid.voxels.min(axis=0) * 0.005, (grid.voxels.max(axis=0) + 1) * 0.005
    dense = obvious.DenseMap(low, high, 0.005)
    total += timed(lambda: [dense.add(one) for one in segments])[1]
    points = sample_segments(everything, 0.0025)[0]
    total += timed(lambda: obvious.forest(obvious.smoothed(points), 0.005))[1]
    index = VoxelIndex(grid.voxels)
    graph, build = timed(
        lambda: obvious.explicit_graph(grid.voxels, grid.empty_probability(), index)
    )
    sources = index.find(voxels_of(initial.vertices_in_base, 0.005))
    single = timed(lambda: dijkstra(graph, indices=sources, min_only=True))[1]
    pieces = initial.components()[0]
    return total + build + single * float(np.sum(np.arange(pieces - len(joins), pieces + 1)))
