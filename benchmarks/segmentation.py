"""Curves, picture sheet and figures of the built-in weights, from the folder they were trained in.

python benchmarks/segmentation.py FOLDER ../shared/data/recordings --output DIR
"""

import argparse
import json
import os
from functools import partial
from pathlib import Path
from time import process_time

os.environ["OMP_NUM_THREADS"] = "1"

import cv2
import matplotlib.pyplot as plt
import numpy as np

from canopy_skel.recording import read_recording
from canopy_skel.segmenters.unet.grouping import candidates_of, chosen
from canopy_skel.segmenters.unet.precision import has_fast_bfloat16
from canopy_skel.segmenters.unet.segmenter import UNetSegmenter
from canopy_skel.segmenters.unet.weights import BUILTIN, load
from service.evaluation import evaluate_recording
from service.segmenters import make_for_judging
from service.training.recipe import halves_of
from service.training.store import StoredImages

RECORDINGS = ("apple_fd2", "oak_fd3", "apple_dense", "walnut_stereo")
SHOWN = {
    "line_ap": "line-AP",
    "ap50": "AP50",
    "precision_wood": "precision (wood)",
    "precision": "precision (matched)",
    "recall": "recall",
    "pixel_iou": "pixel IoU",
    "cl_dice": "clDice",
    "ece": "ECE",
    "instances_true": "branches",
}
ENDS = (
    *("P recorded", "P unet", "ratio"),
    *("R recorded", "R unet", "ratio"),
    *("OSR recorded", "OSR unet"),
)
TILE = (480, 360)
TIMES = 12
LOSSES = ("branch", "centre", "direction", "radius", "middle", "length")


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path, help="where `canopy train` has worked")
    parser.add_argument("recordings", type=Path)
    parser.add_argument("--output", type=Path, required=True)
    arguments = parser.parse_args()
    arguments.output.mkdir(parents=True, exist_ok=True)
    entries = log_of(arguments.folder)
    lines = [json.dumps(entry) + "\n" for entry in entries]
    (arguments.output / "log.jsonl").write_text("".join(lines))
    curves(entries, arguments.output / "curves.png")
    validate = halves_of(StoredImages(arguments.folder / "data" / "validate"))
    sheet(validate.report, arguments.output / "sheet.jpg")
    results = [compared(arguments.recordings / f"{name}.mcap") for name in RECORDINGS]
    (arguments.output / "README.md").write_text(page(results, speed()))


def log_of(folder):
    """Return the log of all runs; steps and minutes are counted on from the run before."""
    entries, before = [], {"step": 0, "minutes": 0.0}
    for path in sorted(folder.glob("run*/log.jsonl")):
        own = [json.loads(line) for line in path.read_text().splitlines()]
        entries += [entry | {name: entry[name] + before[name] for name in before} for entry in own]
        before = {name: entries[-1][name] for name in before}
    return entries


def curves(entries, path):
    steps = [entry["step"] for entry in entries]
    figure, axes = plt.subplots(1, 3, figsize=(12, 3.2), layout="constrained")
    for axis, names, title in (
        (axes[0], LOSSES, "training loss, smoothed"),
        (
            axes[1],
            ("val_iou", "val_centre_iou", "val_middle"),
            "validation of another kind: overlap of cells, error of place",
        ),
        (axes[2], ("val_angle_median", "val_angle_p90"), "error of direction, degrees"),
    ):
        for name in names:
            axis.plot(steps, [entry.get(name, np.nan) for entry in entries], label=name)
        axis.set_title(title)
        axis.set_xlabel("step")
        axis.legend()
    figure.savefig(path, dpi=90)
    plt.close(figure)


def sheet(images, path):
    """Pictures of the reporting half: as seen, as labelled, as found."""
    segmenter = UNetSegmenter(load())
    chosen = sorted(range(len(images)), key=lambda k: -len(images[k].lines))[::5][:8]
    rows = []
    for number in chosen:
        image = images[number]
        label = np.zeros(image.ignore.shape, np.int64)
        for k, mask in enumerate(found_in(segmenter, image.color_rgb), start=1):
            height, width = mask.mask.shape
            part = label[mask.top_px : mask.top_px + height, mask.left_px : mask.left_px + width]
            part[mask.mask] = k
        tiles = [image.color_rgb, coloured(image.instances, image.ignore), coloured(label, None)]
        rows.append(np.hstack([cv2.resize(t, TILE, interpolation=cv2.INTER_AREA) for t in tiles]))
    halves = [np.vstack(rows[: len(rows) // 2]), np.vstack(rows[len(rows) // 2 :])]
    picture = np.ascontiguousarray(np.hstack(halves)[..., ::-1])
    cv2.imwrite(str(path), picture, [cv2.IMWRITE_JPEG_QUALITY, 78])


def found_in(segmenter, color_rgb):
    from canopy_skel.frame import Intrinsics, View

    height, width = color_rgb.shape[:2]
    lens = Intrinsics(fx_px=width, fy_px=width, cx_px=0, cy_px=0, width_px=width, height_px=height)
    pose = np.eye(4)
    return segmenter.segment(
        View(index=0, stamp_ns=0, color_rgb=color_rgb, intrinsics=lens, base_from_camera=pose)
    )


def coloured(label, ignore):
    palette = np.random.default_rng(1).integers(70, 256, (int(label.max()) + 1, 3))
    palette[0] = 0
    picture = palette[label].astype(np.uint8)
    if ignore is not None:
        picture[ignore] = 90
    return picture


def compared(recording):
    segmenter, threshold = make_for_judging("unet")
    return evaluate_recording(
        recording, segmenter, threshold, name="unet", weights=None, memory_limit_bytes=4 << 30
    )


def speed():
    """CPU seconds of one 1440 x 1080 picture on one thread: network, grouping, scores."""
    path = next(Path(__file__).parents[1].glob("recordings/*.mcap"))
    color = next(iter(read_recording(path).views())).color_rgb
    picture = cv2.resize(np.array(color), (1440, 1080))
    model = load()
    seconds = {}
    for name, bfloat16 in (("float32", False), ("bfloat16", True)):
        if bfloat16 and not has_fast_bfloat16():
            continue
        segmenter = UNetSegmenter(model, bfloat16=bfloat16)
        known, seconds[f"network {name}"] = timed(segmenter.known, picture)
        strands = candidates_of(known.maps, model.grouping)
        scored = partial(model.scorer.scores, known, strands, bfloat16=bfloat16)
        scores, seconds[f"scores {name}"] = timed(scored)
    _, grouping = timed(candidates_of, known.maps, model.grouping)
    _, choice = timed(chosen, known.maps, strands, scores, model.grouping)
    return seconds | {f"grouping into {len(strands.cells)} strands": grouping + choice}


def timed(function, *arguments):
    best = np.inf
    for _ in range(TIMES):
        start = process_time()
        result = function(*arguments)
        best = min(best, process_time() - start)
    return result, best


def cpu_model():
    names = [
        line for line in Path("/proc/cpuinfo").read_text().splitlines() if "model name" in line
    ]
    return names[0].split(":")[1].strip() if names else "unknown"


def page(results, seconds):
    facts = json.loads(BUILTIN.with_suffix(".json").read_text())
    return "\n".join([*trained(facts), *end_to_end(results), *time_taken(seconds)])


def trained(facts):
    training, validation = facts["training"], facts["validation"]
    return [
        "# The built-in weights of the unet segmenter, measured",
        "",
        "Made by `benchmarks/segmentation.py`. Every picture is synthetic: nothing here says how"
        " the segmenter does in an orchard.",
        "",
        f"Trained for {training['steps']} steps of"
        f" {' and '.join(str(plan['batch']) for plan in training['plan'])} crops"
        f" in {len(training['plan'])} runs ({training['minutes']:g} minutes of wall time on a"
        f" shared core, {training['pictures']} pictures)."
        " [log.jsonl](log.jsonl); ![curves](curves.png)",
        "",
        "## Validation of another kind",
        "",
        f"{validation['kind'].capitalize()}. Checkpoint, calibration and threshold"
        f" ({facts['least_score']}) were chosen on one half of the scenes, the other half reports."
        " What each figure means: [segmentation.md](../../segmentation.md).",
        "",
        *table(
            ("half", *SHOWN.values()),
            [
                (name, *(f"{validation[half][key]:g}" for key in SHOWN))
                for name, half in (("chosen on", "chosen_on"), ("**reported**", "reported"))
            ],
        ),
        "",
        "Seen, labelled (grey: too small), found:",
        "![Pictures of the reporting half in three columns](sheet.jpg)",
        "",
    ]


def end_to_end(results):
    return [
        "## End to end, on recordings of another generator",
        "",
        "Skeletons from learned masks beside those from the recorded (true) masks, method `paper`.",
        "",
        *table(
            ("recording", *ENDS),
            [(Path(one.source).stem, *ends(one.skeleton)) for one in results],
        ),
        "",
        "The instances themselves, as `canopy segment --evaluate` compares them with the recorded"
        " ones, however thin those are; what is nobody's label counts as false:",
        "",
        *table(
            ("recording", *SHOWN.values()),
            [
                (Path(one.source).stem, *(f"{one.scores.to_dict()[key]:.4g}" for key in SHOWN))
                for one in results
            ],
        ),
        "",
    ]


def time_taken(seconds):
    return [
        "## Time",
        "",
        f"CPU seconds of one 1440 x 1080 picture, one thread, the best of {TIMES}, {cpu_model()}"
        f" ({'with' if has_fast_bfloat16() else 'without'} bfloat16): "
        + ", ".join(f"{name} {value:.3f}" for name, value in seconds.items())
        + ".",
        "",
    ]


def table(heads, rows):
    return [f"| {' | '.join(cells)} |" for cells in (heads, ["---"] * len(heads), *rows)]


def ends(skeleton):
    for key in ("precision", "recall"):
        yield from (f"{skeleton[name][key]:.3f}" for name in ("recorded", "unet", "ratio"))
    yield from (f"{skeleton[name]['osr']:.3f}" for name in ("recorded", "unet"))


if __name__ == "__main__":
    main()
