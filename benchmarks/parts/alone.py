"""What a process of its own takes: memory of a scan, time to the first skeleton."""

import os
import resource
import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryDirectory
from time import perf_counter

from parts.common import table

from canopy_skel.recording import RecordingWriter, read_recording

ROOT = Path(__file__).parents[2]
RECORDING = ROOT / "recordings/demo_apple.mcap"
SCAN = """
from parts.alone import peak_mb
from parts.common import Engine, clusters_of_views
from parts.updates import update
views = clusters_of_views(45, {views})
engine, before = Engine(0.005), peak_mb()
for clusters in views:
    update(engine, clusters)
print(before, peak_mb())
"""
START = "from service.start import main; main()"
METHODS = ("canopy", "paper")


def report(quick, _output, kept):
    views = 20 if quick else 70
    before, peak = kept(f"memory-{views}", lambda: memory_mb(views))
    rows = [row for method in METHODS for row in kept(f"start-{method}", lambda m=method: first(m))]
    text = (
        "## A process of its own\n\n"
        f"5 mm, 2 x 2 x 2 m, a skeleton after each view: {peak:.0f} MB at most, {before:.0f} MB of"
        " them libraries and input.\n\n"
    )
    head = ("method", "kernels", "clock s", "CPU s of all processes", "load before")
    name = f"`canopy replay` of {RECORDING.stem}, start to end: its first view, and all four"
    text += table(name, ("views", *head), rows)
    text += (
        f"\nOn {os.cpu_count()} cores. With no kernels yet, those a method needs are compiled"
        " first, on all cores, and no others. Load: jobs that ran or waited on average in the"
        " minute before; at more than 0 the clock shows other jobs too.\n"
    )
    facts = {(kernels, method): clock for views, method, kernels, clock, *_ in rows if views == 1}
    return text, facts | {"memory": peak}


def first(method):
    """Return rows of a replay of one view with nothing compiled, of one after it, and of all."""
    with TemporaryDirectory() as folder:
        path = Path(folder) / "first.mcap"
        with RecordingWriter(path, {"scan_id": "first"}) as writer:
            writer.write_view(next(iter(read_recording(RECORDING).views())))
        return [
            (views, method, kernels, *replayed(recording, method, folder))
            for views, kernels, recording in (
                (1, "none yet", path),
                (1, "on disk", path),
                (4, "on disk", RECORDING),
            )
        ]


def replayed(recording, method, cache):
    """Return seconds by the clock, of all processes together, and the load before."""
    (load, _, _), start, cpu = os.getloadavg(), perf_counter(), children_s()
    with TemporaryDirectory() as output:
        run(START, "replay", recording, "-o", output, "--method", method, NUMBA_CACHE_DIR=cache)
    return perf_counter() - start, children_s() - cpu, load


def children_s():
    usage = resource.getrusage(resource.RUSAGE_CHILDREN)
    return usage.ru_utime + usage.ru_stime


def memory_mb(views):
    return [float(number) for number in run(SCAN.format(views=views)).split()]


def peak_mb():
    """Return the most memory held since this program began; `getrusage` counts its parent's too."""
    status = Path("/proc/self/status").read_text()
    return int(status.split("VmHWM:")[1].split()[0]) / 1024


def run(code, *arguments, **environment):
    """Run code in a Python of its own; return what it prints."""
    path = os.pathsep.join([str(ROOT), str(ROOT / "benchmarks")])
    done = subprocess.run(
        [sys.executable, "-c", code, *arguments],
        env={**os.environ, "PYTHONPATH": path, **environment},
        capture_output=True,
        text=True,
        check=True,
    )
    return done.stdout
