"""Method canopy beside method paper: the figures it must reach, on given recordings with truth.

python benchmarks/canopy_table.py REC... --output docs/results/canopy.md --cache out/canopy-table
"""

import argparse
import csv
import json
import re
import time
from pathlib import Path

import numpy as np

from canopy_skel.canopy import CanopyConfig
from canopy_skel.document import Method, build_document, from_json
from canopy_skel.fitting import truth_points
from canopy_skel.metrics import score
from canopy_skel.pipeline import MethodConfig, Skeletonizer, models_for
from canopy_skel.recording import read_recording
from canopy_skel.segmenters.mapping import WithMaps
from drivers.stereo import with_depth
from service.experiment.segmenters import segmenter_named
from service.memory import keep_freed_memory

PAPER, CANOPY = MethodConfig(name="paper"), MethodConfig(name="canopy")
RUNS = {
    "paper": ("recorded", PAPER),
    "masks": (
        "recorded",
        MethodConfig(name="canopy", canopy=CanopyConfig(use_fragments=False)),
    ),
    "fragments": ("recorded", CANOPY),
}
WORSE = {
    "paper, worse masks": ("drop25+false20", PAPER),
    "canopy, worse masks": ("drop25+false20", CANOPY),
    "paper, unet": ("unet", PAPER),
    "canopy, unet": ("unet", CANOPY),
}
"""Runs on recordings of medium foliage with what a real detector would see."""
LABELS = {
    "paper": "paper",
    "masks": "canopy, masks only",
    "fragments": "canopy, fragments",
    **{name: name for name in WORSE},
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
M, F = "masks", "fragments"
GOALS = (  # run, figure, at least: a number or a multiple of what paper has
    (M, "precision", (0.95, 0.92, 0.91)),
    (M, "occ_precision", (0.78, 0.79, 0.82)),
    (M, "recall", (0.78, "1.12", "1.2")),
    (M, "recall_unmasked", ("1.6", "1.7", "1.7")),
    (F, "precision", (0.94, 0.90, 0.92)),
    (F, "recall", (0.88, 0.80, "1.5")),
    (F, "recall_unmasked", (0.64, 0.60, "3")),
    (M, "recall_hidden", ("1.4", "1.4", "1.4")),
    (F, "recall_hidden", ("2", "2", "2")),
    *((run, "precision_directional", (0.93, 0.93, 0.93)) for run in (M, F)),
    *((run, "joined", (0.8, 0.8, 0.8)) for run in (M, F)),
)
LIMITS = (  # run, figure, at most
    *((run, "ece", (0.03, 0.05, 0.08)) for run in (M, F)),
    *((run, "ece_occluded", (0.12, 0.10, 0.10)) for run in (M, F)),
    *((run, "length_ratio", (1.1, 1.1, 1.1)) for run in (M, F)),
    *((run, "radius_error_median", (0.18, 0.18, 0.18)) for run in (M, F)),
    *((run, "view_ms", (None, 300, None)) for run in (M, F)),
)
BINS = 10
TIMES = 4
INTRODUCTION = """# Method canopy beside method paper

Made by `benchmarks/canopy_table.py` from simulated trees. Models were fitted and working points
set on other trees (the models' file names them; no walnut is among them). Columns are explained
in [metrics.md](../metrics.md); ms/view is CPU time of the last view and the skeleton after it
(there was one after the view before, as in a live scan), the best of four times, without
segmentation and the network's maps; other work on the machine adds to it. The share of its truth
that no mask covers decides the class of a recording: up to .375 light, over .625 heavy. Masks are
the simulated ones; fragments are told by colour, by the built-in network and by what lies around
each pixel, and simulated pictures are not an orchard's: the rows "masks only" do not depend on
them. (Network and models learned from pictures of the renderer of those that bear a number, of
other trees; those without a number were made by another renderer.)
Rows with *worse masks* (a quarter dropped, a fifth false) and with the masks of the built-in
*unet* show what a real detector would leave of it; they use the confidences for learned masks.
Depth counts up to 3 m, so trees of the next row do not. Each recording by itself:
[canopy-recordings.csv](canopy-recordings.csv).

![masks only](canopy-reliability-masks.svg) ![with fragments](canopy-reliability-fragments.svg)

"""
CLASSES = ("light", "medium", "heavy")
NUMBERED = re.compile(r"(.+_\d+)_fd\d")
"""What `canopy simulate` calls its recordings: the tree, and its foliage density."""


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("recordings", type=Path, nargs="+")
    parser.add_argument("--output", type=Path)
    parser.add_argument("--cache", type=Path, required=True, help="where finished figures are kept")
    parser.add_argument("--worse", action="store_true", help="worse masks too, at medium foliage")
    arguments = parser.parse_args()
    arguments.cache.mkdir(parents=True, exist_ok=True)
    keep_freed_memory()
    results = {}
    for path in arguments.recordings:
        results[path.stem] = figures_of(path, arguments.cache, RUNS)
    for path in arguments.recordings if arguments.worse else ():
        if class_of(results[path.stem]["unmasked"]) == "medium":
            results[path.stem] = figures_of(path, arguments.cache, [*RUNS, *WORSE])
    page = "\n".join([*sample(results), *goal_table(results), *class_tables(results)])
    if arguments.output:
        arguments.output.parent.mkdir(parents=True, exist_ok=True)
        arguments.output.write_text(INTRODUCTION + page)
        for name in ("masks", "fragments"):
            picture = arguments.output.with_name(f"{arguments.output.stem}-reliability-{name}.svg")
            picture.write_text(reliability_diagram(results, name))
        write_recordings(
            arguments.output.with_name(f"{arguments.output.stem}-recordings.csv"), results
        )
    print(page)


def figures_of(path, cache, names):
    """Return the figures of some runs of one recording, from the cache where they are there."""
    kept = cache / f"{path.stem}.json"
    results = json.loads(kept.read_text()) if kept.exists() else {}
    if all(name in results for name in names):
        return results
    recording = read_recording(path)
    views = [with_depth(view) for view in recording.views()]
    truth = from_json(recording.ground_truth)
    results["unmasked"] = unmasked_share(truth)
    for name in names:
        if name not in results:
            results[name] = run(views, truth, *(RUNS | WORSE)[name])
            kept.write_text(json.dumps(results))
    return results


def run(views, truth, segmenter, config):
    inner = segmenter_named(segmenter)
    maker = Skeletonizer(Once(inner, views), config, models=models_for(inner))
    for view in views:
        maker.add_view(view)
    view_ms = []
    for _ in range(TIMES):
        maker.remove_view(views[-1].index)
        maker.skeleton()  # a live scan makes one after every view, and goes on from it
        started = time.process_time()
        maker.add_view(views[-1])
        graph = maker.skeleton().graph
        view_ms.append(1000 * (time.process_time() - started))
    document = build_document(
        graph,
        scan_id="table",
        revision=len(views),
        method=Method(name=config.name),
        views_used=len(views),
    )
    return score(document, truth).to_dict() | {
        "view_ms": min(view_ms),
        "reliability": reliability(document, truth),
    }


class Once:
    """A segmenter that has seen all views already, so that its time does not count."""

    def __init__(self, inner, views):
        finder = WithMaps(inner)
        self.seen = {view.index: finder.segment_and_map(view) for view in views}

    def segment(self, view):
        return self.seen[view.index][0]

    def segment_and_map(self, view):
        return self.seen[view.index]


def reliability(document, truth):
    """Return per part and bin of confidence [vertices, sum of confidence, right ones]."""
    distance = truth_points(truth).query(document.position)[0]
    which = np.clip((document.confidence * BINS).astype(int), 0, BINS - 1)
    table = {}
    for part, chosen in (("observed", ~document.occluded), ("predicted", document.occluded)):
        columns = (np.ones(len(distance)), document.confidence, distance <= 0.02)
        sums = [np.bincount(which[chosen], c[chosen], BINS).tolist() for c in columns]
        table[part] = list(zip(*sums, strict=True))
    return table


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


def reliability_diagram(results, run_name):
    """Return an SVG: share right over mean confidence, area of a dot by its vertices."""
    marks = []
    for part, colour in (("observed", "#0072b2"), ("predicted", "#d55e00")):
        total = np.sum([r[run_name]["reliability"][part] for r in results.values()], axis=0)
        for count, confidence, right in total[total[:, 0] > 0]:
            x, y = 40 + 240 * confidence / count, 260 - 240 * right / count
            radius = 2 + 10 * np.sqrt(count / total[:, 0].sum())
            marks.append(f'<circle cx="{x:.1f}" cy="{y:.1f}" r="{radius:.1f}" fill="{colour}"/>')
    return (
        '<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 300 300" font-size="11"'
        ' font-family="sans-serif"><rect width="300" height="300" fill="#fff"/>'
        '<path d="M40 20V260H280" fill="none" stroke="#000"/>'
        '<path d="M40 260L280 20" stroke="#999" stroke-dasharray="4"/>'
        '<text x="130" y="282">confidence</text><text x="22" y="264">0</text>'
        '<text x="276" y="275">1</text><text x="28" y="26">1</text>'
        '<text x="50" y="34" fill="#0072b2">observed</text>'
        '<text x="50" y="48" fill="#d55e00">predicted</text>'
        f'<text x="110" y="14">share right, {LABELS[run_name]}</text>' + "".join(marks) + "</svg>\n"
    )


def sample(results):
    """Yield what was measured."""
    numbered = {stem: NUMBERED.fullmatch(stem) for stem in sorted(results)}
    trees = sorted({match[1] for match in numbered.values() if match})
    others = [stem for stem, match in numbered.items() if not match]
    yield (
        f"{len(results)} recordings: {len(results) - len(others)} of {len(trees)} trees"
        f" ({', '.join(trees)}), and {', '.join(others)}."
    )
    yield ""


def goal_table(results):
    """Yield a table of what was asked, what was measured, and whether that is enough."""
    yield "## Goals"
    yield ""
    yield (
        "Asked → measured, mean of the class ± its standard error; × is times the mean that `paper`"
        " has."
    )
    yield ""
    yield "| | " + " | ".join(CLASSES) + " |"
    yield "|---|" + "---|" * len(CLASSES)
    chosen = {
        name: [r for r in results.values() if class_of(r["unmasked"]) == name] for name in CLASSES
    }
    for sign, table in (("≥", GOALS), ("≤", LIMITS)):
        for run_name, figure, asked in table:
            cells = [
                goal_cell(chosen[name], run_name, figure, limit, sign)
                for name, limit in zip(CLASSES, asked, strict=True)
            ]
            yield f"| {LABELS[run_name]}: {FIGURES[figure]} | " + " | ".join(cells) + " |"
    yield ""


def goal_cell(results, run_name, figure, limit, sign):
    values = [r[run_name][figure] for r in results if r[run_name][figure] is not None]
    if limit is None or not values:
        return ""
    value, asked = np.mean(values), float(limit)
    digits = 0 if figure == "view_ms" else 3
    measured = f"{value:.{digits}f} ± {np.std(values, ddof=1) / len(values) ** 0.5:.{digits}f}"
    if isinstance(limit, str):
        value /= mean_figures(results, "paper")[figure]
        limit, measured = f"{limit} ×", f"{value:.2f}"
    good = value >= asked if sign == "≥" else value <= asked
    return f"{sign} {limit} → {measured} {'reached' if good else '**missed**'}"


def class_tables(results):
    for name in CLASSES:
        chosen = [r for r in results.values() if class_of(r["unmasked"]) == name]
        yield f"## {name}: {len(chosen)} recordings"
        yield ""
        yield from header("method")
        for run_name in RUNS | WORSE:
            seen = [result for result in chosen if run_name in result]
            if seen:
                yield row(LABELS[run_name], mean_figures(seen, run_name))
        yield ""


def mean_figures(results, run_name):
    means = {}
    for figure in FIGURES:
        values = [r[run_name][figure] for r in results if r[run_name][figure] is not None]
        means[figure] = float(np.mean(values)) if values else None
    return means


def write_recordings(path, results):
    """Write the figures of each recording and run as CSV."""
    with path.open("w", newline="") as file:
        table = csv.writer(file, lineterminator="\n")
        table.writerow(["recording", "unmasked", "run", *FIGURES])
        for stem, result in sorted(results.items()):
            for run_name in [name for name in RUNS | WORSE if name in result]:
                figures = [
                    "" if result[run_name][figure] is None else f"{result[run_name][figure]:.4f}"
                    for figure in FIGURES
                ]
                table.writerow([stem, f"{result['unmasked']:.3f}", LABELS[run_name], *figures])


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
