"""Method canopy beside method paper: the figures it must reach, on given recordings with truth.

python benchmarks/canopy_table.py REC... --output docs/results/canopy.md --cache out/canopy-table
"""

import argparse
import json
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from canopy_skel.canopy import CanopyConfig
from canopy_skel.document import Method, build_document, from_json
from canopy_skel.metrics import score
from canopy_skel.pipeline import MethodConfig, Skeletonizer
from canopy_skel.recording import read_recording
from canopy_skel.segmenters.recorded import RecordedSegmenter
from drivers.stereo import with_depth

RUNS = {
    "paper": MethodConfig(name="paper"),
    "masks": MethodConfig(name="canopy", canopy=CanopyConfig(use_fragments=False)),
    "fragments": MethodConfig(name="canopy"),
}
LABELS = {
    "paper": "paper",
    "masks": "canopy, masks only",
    "fragments": "canopy, colour fragments",
}
FIGURES = {
    "precision": "P",
    "precision_directional": "P_dir",
    "recall": "R",
    "recall_unmasked": "R unmasked",
    "recall_hidden": "R hidden",
    "occ_precision": "occ P",
    "joined": "joined",
    "length_ratio": "length ratio",
    "radius_error_median": "radius err",
    "ece": "ECE",
    "ece_occluded": "ECE pred.",
    "auc": "auc",
    "components": "parts",
    "view_ms": "ms/view",
}
CLASSES = ("light", "medium", "heavy")


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("recordings", type=Path, nargs="+")
    parser.add_argument("--output", type=Path)
    parser.add_argument("--cache", type=Path, required=True, help="where finished figures are kept")
    arguments = parser.parse_args()
    arguments.cache.mkdir(parents=True, exist_ok=True)
    results = {path.stem: figures_of(path, arguments.cache) for path in arguments.recordings}
    page = "\n".join([*class_tables(results), *recording_table(results)]) + "\n"
    if arguments.output:
        arguments.output.write_text(page)
    print(page)


def figures_of(path, cache):
    """Return the figures of all runs of one recording, from the cache where they are there."""
    kept = cache / f"{path.stem}.json"
    if kept.exists():
        return json.loads(kept.read_text())
    recording = read_recording(path)
    views = [with_depth(view) for view in recording.views()]
    truth = from_json(recording.ground_truth)
    results = {"unmasked": unmasked_share(truth)}
    for name, config in RUNS.items():
        results[name] = run(views, truth, config)
    kept.write_text(json.dumps(results))
    return results


def run(views, truth, config):
    maker = Skeletonizer(RecordedSegmenter(), replace(config))
    for view in views[:-1]:
        maker.add_view(view)
    started = time.process_time()
    maker.add_view(views[-1])
    graph = maker.skeleton().graph
    view_ms = 1000 * (time.process_time() - started)
    document = build_document(
        graph,
        scan_id="table",
        revision=len(views),
        method=Method(name=config.name),
        views_used=len(views),
    )
    return score(document, truth).to_dict() | {"view_ms": view_ms}


def unmasked_share(truth):
    """Return the share of the framed true length that no mask covers."""
    start, end = truth.edges.T
    length = np.linalg.norm(truth.position[start] - truth.position[end], axis=1)
    framed = np.array(truth.extra.get("framed", np.ones(len(truth.position))), dtype=bool)[end]
    masked = np.array(truth.extra["segmented"], dtype=bool)[end]
    return float(length[framed & ~masked].sum() / length[framed].sum())


def class_of(unmasked):
    """Return the density class: up to .35 light, .4 to .6 medium, from .65 heavy; else the nearer.

    The limits are halfway between these.
    """
    return CLASSES[int(unmasked > 0.375) + int(unmasked > 0.625)]


def class_tables(results):
    for name in CLASSES:
        chosen = [r for r in results.values() if class_of(r["unmasked"]) == name]
        yield f"## {name}: {len(chosen)} recordings"
        yield ""
        yield from header("method")
        for run_name in RUNS:
            yield row(LABELS[run_name], mean_figures(chosen, run_name))
        yield ""


def mean_figures(results, run_name):
    means = {}
    for figure in FIGURES:
        values = [r[run_name][figure] for r in results if r[run_name][figure] is not None]
        means[figure] = float(np.mean(values)) if values else None
    return means


def recording_table(results):
    yield "## Each recording"
    yield ""
    yield from header("recording, method")
    for stem, result in sorted(results.items()):
        for run_name in RUNS:
            yield row(f"{stem} ({result['unmasked']:.2f}), {LABELS[run_name]}", result[run_name])


def header(first):
    yield f"| {first} | " + " | ".join(FIGURES.values()) + " |"
    yield "|---|" + "---|" * len(FIGURES)


def row(label, figures):
    cells = []
    for name in FIGURES:
        value = figures[name]
        digits = {"components": 1, "view_ms": 0}.get(name, 3)
        cells.append("–" if value is None else f"{value:.{digits}f}")
    return f"| {label} | " + " | ".join(cells) + " |"


if __name__ == "__main__":
    main()
