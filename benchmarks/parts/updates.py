"""A fresh skeleton after every view: what each stage of it costs, and against a new start."""

import numpy as np
from parts.common import CONFIG, Engine, clusters_of_views, picture, table, timed

from canopy_skel.cluster import cluster_branches
from canopy_skel.likelihood import segments_of
from canopy_skel.pathsearch import PathSearch
from canopy_skel.spline import fit_splines

STAGES = ("clusters", "fit", "map", "strands", "initial", "repair", "preview", "joins", "paths")


def report(quick, _output, kept):
    rows, facts = [], {}
    for voxel_mm in (10, 5) if quick else (10, 5, 2.5):
        for fragments in (45, 300):
            scene = (voxel_mm / 1000, fragments, 20 if quick else 70)
            name = f"updates-{voxel_mm}mm-{fragments}-{scene[-1]}"
            row, found = kept(name, lambda scene=scene: row_of(*scene))
            rows.append(row)
            facts |= {(name, voxel_mm, fragments): value for name, value in found.items()}
    head = ("mm", "fragments seen", "views", *STAGES, "**all**", "all, most", "scratch / repair")
    text = table("A fresh skeleton after every view: median ms of the last ten views", head, rows)
    text += (
        "\n`all` leaves out masks and the preview. `clusters` are those of a picture of as many"
        " masks of about 1000 pixels. `scratch / repair` is a new search over the repair of the old"
        " one; distances were compared and are equal to the bit.\n"
    )
    return text, facts


def row_of(voxel_m, fragments, views):
    engine, times = Engine(voxel_m), []
    for clusters in clusters_of_views(fragments, views):
        times.append(update(engine, clusters)[0])
    initial, repair = engine.observed(), np.median([t["repair"] for t in times[-10:]])
    fresh = PathSearch(engine.map)
    scratch = timed(lambda: fresh.update(initial))[1]
    if not np.array_equal(fresh.distances, engine.search.distances):
        raise SystemExit("the repaired distances are not those of a new search")
    last = times[-10:]
    whole = [sum(t[s] for s in STAGES if s != "preview") for t in last]
    medians = [float(np.median([t[s] for t in last])) for s in STAGES]
    pieces = initial.components()[0]
    ratio = f"{scratch:.0f} / {repair:.0f} = {scratch / repair:.0f} x"
    facts = {
        "update": float(np.median(whole)),
        "preview": float(np.median([t["preview"] for t in last])),
        "repair": scratch / repair,
    }
    row = (1000 * voxel_m, pieces, views, *medians, facts["update"], max(whole), ratio)
    return row, facts


def update(engine, clusters):
    """Add a view; return what each stage took and the skeleton."""
    ms, (view, masks) = {}, picture(len(clusters))
    _, ms["clusters"] = timed(lambda: cluster_branches(view, masks, CONFIG.cluster))
    splines, ms["fit"] = timed(lambda: fit_splines(clusters, CONFIG.spline))
    segments = segments_of(splines)
    _, ms["map"] = timed(lambda: engine.map.add(segments))
    _, ms["strands"] = timed(lambda: engine.strands.add(segments))
    initial, ms["initial"] = timed(engine.observed)
    _, ms["repair"] = timed(lambda: engine.search.update(initial))
    _, ms["preview"] = timed(lambda: engine.joined(initial, engine.search.preview()))
    joins, ms["joins"] = timed(engine.search.joins)
    graph, ms["paths"] = timed(lambda: engine.joined(initial, joins))
    return ms, graph
