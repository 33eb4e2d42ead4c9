"""Score the methods on recordings with attached truth, as a user would: by the command line.

python benchmarks/recordings.py ../shared/data/recordings --output docs/results.md
"""

import argparse
import json
import os
import platform
import sys
import tempfile
from pathlib import Path
from time import perf_counter

CANOPY = Path(sys.executable).with_name("canopy")
METHODS = ("canopy", "paper", "mst", "ftsem")
COLUMNS = {
    "precision": "P",
    "precision_directional": "P_dir",
    "recall": "R",
    "recall_masked": "R masked",
    "recall_unmasked": "R unmasked",
    "occ_precision": "occ P",
    "osr": "OSR",
    "joined": "joined",
    "length_ratio": "length ratio",
    "components": "components",
    "radius_error_median": "radius err",
    "auc": "auc",
    "acyclic": "acyclic",
}


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("recordings", type=Path)
    parser.add_argument("--output", type=Path)
    arguments = parser.parse_args()
    paths = sorted(arguments.recordings.glob("*.mcap"))
    if not paths:
        sys.exit(f"{arguments.recordings}: no recordings there")
    rows = [measure(path, method) for method in METHODS for path in paths]
    page = report(rows)
    if arguments.output:
        arguments.output.write_text(page)
    print(page)


def measure(path, method):
    with tempfile.TemporaryDirectory() as out:
        arguments = ["replay", path, "-o", out, "--method", method, "--segmenter", "recorded"]
        seconds, peak_mib = run(*arguments)
        skeleton = Path(out) / f"{path.stem}.skeleton.json"
        scores = json.loads(os.popen(f"{CANOPY} score {skeleton} {path} --json").read())
    return {"method": method, "recording": path.stem, "s": seconds, "MiB": peak_mib, **scores}


def run(*arguments):
    """Return wall seconds and peak memory of one run of the command line."""
    start = perf_counter()
    child = os.fork()
    if child == 0:
        silent = os.open(os.devnull, os.O_WRONLY)
        os.dup2(silent, 1)
        os.execv(CANOPY, [str(a) for a in (CANOPY, *arguments)])
    _, status, usage = os.wait4(child, 0)
    if os.waitstatus_to_exitcode(status) != 0:
        sys.exit(f"canopy {' '.join(map(str, arguments))} failed")
    return perf_counter() - start, usage.ru_maxrss / 1024


def report(rows):
    head = ["method", "recording", *COLUMNS.values(), "s", "peak MiB"]
    lines = [
        "# Results on recordings made by others",
        "",
        "Made by `make results`; the recordings and their truth come from a generator that shares",
        "nothing with this project, and each figure is explained in [metrics.md](metrics.md).",
        f"`s` is wall time of the whole command on {os.cpu_count()} cores ({platform.machine()}),",
        "start of Python included; the synthetic trees say nothing about real orchards.",
        "",
        "| " + " | ".join(head) + " |",
        "|" + "---|" * len(head),
    ]
    for method in METHODS:
        own = [row for row in rows if row["method"] == method]
        lines += [line(row) for row in own]
        lines.append(line({"method": method, "recording": "**mean**", **mean(own)}))
    return "\n".join(lines) + "\n"


def mean(rows):
    numbers = [key for key in (*COLUMNS, "s", "MiB") if key != "acyclic"]
    means = {key: sum(row[key] or 0 for row in rows) / len(rows) for key in numbers}
    return {**means, "acyclic": all(row["acyclic"] for row in rows)}


def line(row):
    cells = [row["method"], row["recording"], *(shown(row[key]) for key in COLUMNS)]
    return "| " + " | ".join([*cells, f"{row['s']:.1f}", f"{row['MiB']:.0f}"]) + " |"


def shown(value):
    if isinstance(value, bool):
        return "yes" if value else "no"
    return f"{value:.3f}" if isinstance(value, float) else "–" if value is None else str(value)


if __name__ == "__main__":
    main()
