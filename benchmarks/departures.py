"""What each departure from the paper is worth: one setting changed at a time, on given recordings.

python benchmarks/departures.py ../shared/data/recordings --output docs/departures.md
"""

import argparse
import sys
from dataclasses import replace
from pathlib import Path

from canopy_skel.document import Method, build_document, from_json
from canopy_skel.metrics import score
from canopy_skel.pipeline import MethodConfig, Skeletonizer
from canopy_skel.recording import read_recording
from canopy_skel.segmenters.recorded import RecordedSegmenter
from drivers.stereo import with_depth

CHANGES = {
    "**as shipped**": {},
    "no centre shift": {"spline.centre_shift": 0.0},
    "radius: extent along PC2": {"spline.radius": "extent"},
    "profile followed by however few pixels": {"cluster.min_trusted_share": 0.0},
    "every mask eroded": {"cluster.min_eroded_share": 0.0},
    "no mask eroded": {"cluster.erosion_px": 0},
    "no smoothing": {"initial.smoothing_steps": 0},
    "spurs kept": {"initial.spur_m": 0.0},
    "voxel paths not straightened": {"straighten_steps": 0},
}
FIGURES = ("precision", "precision_directional", "recall_masked", "joined", "length_ratio")


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("recordings", type=Path)
    parser.add_argument("--output", type=Path)
    arguments = parser.parse_args()
    scans = {path.stem: load(path) for path in sorted(arguments.recordings.glob("*.mcap"))}
    if not scans:
        sys.exit(f"{arguments.recordings}: no recordings there")
    lines = [
        "# What each departure from the paper is worth",
        "",
        "Made by `make departures`: mode `paper`, one setting changed at a time (see",
        "[method.md](method.md)). Columns: precision / directional precision / recall of masked",
        "truth / gaps joined / length ratio, each explained in [metrics.md](metrics.md).",
        "One simulated tree and one run each: differences under .01 mean nothing.",
        "",
        "| | " + " | ".join(scans) + " |",
        "|---|" + "---|" * len(scans),
    ]
    for name, changes in CHANGES.items():
        config = changed(MethodConfig(name="paper"), changes)
        cells = [figures(views, truth, config) for views, truth in scans.values()]
        setting = ", ".join(f"`{key} = {value}`" for key, value in changes.items())
        lines.append(f"| {name} {setting} | " + " | ".join(cells) + " |")
    page = "\n".join(lines) + "\n"
    if arguments.output:
        arguments.output.write_text(page)
    print(page)


def load(path):
    recording = read_recording(path)
    return [with_depth(view) for view in recording.views()], from_json(recording.ground_truth)


def changed(config, changes):
    for key, value in changes.items():
        stage, _, name = key.rpartition(".")
        part = replace(getattr(config, stage), **{name: value}) if stage else value
        config = replace(config, **{stage or name: part})
    return config


def figures(views, truth, config):
    skeletonizer = Skeletonizer(RecordedSegmenter(), config)
    for view in views:
        skeletonizer.add_view(view)
    document = build_document(
        skeletonizer.skeleton().graph,
        scan_id="departure",
        revision=len(views),
        method=Method(name="paper"),
        views_used=len(views),
    )
    scores = score(document, truth).to_dict()
    return " / ".join(f"{scores[name] or 0.0:.3f}" for name in FIGURES)


if __name__ == "__main__":
    main()
