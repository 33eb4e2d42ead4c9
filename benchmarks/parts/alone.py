"""What a process of its own takes: memory of a scan, time to the first skeleton."""

import os
import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

ROOT = Path(__file__).parents[2]
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
START = """
import time
from contextlib import nullcontext
from service.live import warm_up
warm_up(lambda name: nullcontext())
print(time.process_time())
"""


def report(quick, _output):
    before, peak = run(SCAN.format(views=20 if quick else 70))
    with TemporaryDirectory() as cache:
        (cold,), (warm,) = (run(START, NUMBA_CACHE_DIR=cache) for _ in range(2))
    text = (
        "## A process of its own\n\n"
        f"5 mm, 2 x 2 x 2 m, a skeleton after each view: {peak:.0f} MB at most, {before:.0f} MB of"
        " them libraries and input.\n\nFrom the start of Python to the first skeleton:"
        f" {cold:.1f} CPU-s with nothing compiled yet, {warm:.1f} with kernels on disk.\n"
    )
    return text, {"memory": peak, "cold": cold, "warm": warm}


def peak_mb():
    """Return the most memory held since this program began; `getrusage` counts its parent's too."""
    status = Path("/proc/self/status").read_text()
    return int(status.split("VmHWM:")[1].split()[0]) / 1024


def run(code, **environment):
    """Run code in a Python of its own; return the numbers it prints."""
    path = os.pathsep.join([str(ROOT), str(ROOT / "benchmarks")])
    done = subprocess.run(
        [sys.executable, "-c", code],
        env={**os.environ, "PYTHONPATH": path, **environment},
        capture_output=True,
        text=True,
        check=True,
    )
    return [float(number) for number in done.stdout.split()]
