"""Time every stage beside the obvious way to do it, in one run on the same input.

    python benchmarks/stages.py [--quick] [--output docs/results [--page NAME]] [--keep FOLDER]
        [part ...]

Parts: stages, updates, alone, scaling, replay; all of them if none is named. Prints tables and,
with --output, writes them to bench.md or another page there, and the scaling curves to
bench-scaling.png. Times are CPU time of the thread, the least of some runs or the median over
views: the machine's speed cancels out of the ratios, other jobs nearly do. What `alone` times by
the clock wants an idle machine, so `make bench` gives it a page of its own. With --keep, what was
measured in an earlier run is taken from that folder: an interrupted run goes on; empty the folder
to measure anew. The obvious way takes 5 GB at 2.5 mm.
"""

import argparse
import platform
from pathlib import Path

from parts import alone, closing, replay, scaling, stages, updates
from parts.kept import Kept

PARTS = {
    "stages": stages.report,
    "updates": updates.report,
    "alone": alone.report,
    "scaling": scaling.report,
    "replay": replay.report,
}
HEAD = """# Benchmarks

Made by {how} on {machine}. Times are milliseconds of CPU
of one thread where nothing else is said. The canopy is synthetic (`benchmarks/scene.py`: 66 m of
wood in 2 x 2 x 2 m, 25 instances a view, 2 mm noise) and easier than a real one: no false
detections, perfect poses.
"""


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("parts", nargs="*", choices=[[], *PARTS], default=[])
    parser.add_argument("--quick", action="store_true", help="10 and 5 mm, few views")
    parser.add_argument("--output", type=Path, help="folder for bench.md and the curves")
    parser.add_argument("--page", default="bench.md", help="name of the page")
    parser.add_argument("--keep", type=Path, help="folder for what is measured, and was")
    options = parser.parse_args()
    kept = Kept(options.keep)
    machine = f"{platform.machine()}, Python {platform.python_version()}"
    how = "`make bench`" if not options.quick else "`benchmarks/stages.py --quick`"
    head, texts, facts = HEAD.format(machine=machine, how=how), [], {}
    print(head)
    for name in options.parts or PARTS:
        text, found = PARTS[name](options.quick, options.output, kept)
        print(text, flush=True)
        texts.append(text)
        facts |= found
        if options.output:
            options.output.mkdir(parents=True, exist_ok=True)
            page = "\n".join([head, closing.report(facts), *texts])
            (options.output / options.page).write_text(page)
    print(closing.report(facts))


if __name__ == "__main__":
    main()
