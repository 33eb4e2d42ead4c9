"""What a scan costs per waypoint beyond motion, settling, exposure and rendering.

python benchmarks/waypoints.py [--views 10|70] [--time-scale 3] [--picture-scale 0.5]
                               [--segmenter recorded|unet]

A whole simulated scan over HTTP: the real arm client against the fake controller, bus, worker. The
controller says how long the arm was in motion; five packages at rest are settling; until the
picture's own stamp it is exposed, from there on drawn. The rest of the time from one recorded view
to the next is overhead, and split by what the scan was doing. How far the skeleton is behind is the
time from a view's record to the first skeleton that it is in.
"""

import argparse
import os
import sys
import tempfile
import threading
import time
from contextlib import contextmanager
from pathlib import Path

import httpx2
import numpy as np

from drivers.protocols import Stillness
from mock_hw.fake_ur.process import FakeUr, free_host
from mock_hw.orchard.simulate import Options, prepare
from mock_hw.sim_camera import SimCamera
from service.compose import (
    SIMULATED_LIMITS,
    SIMULATED_PATHS,
    Hardware,
    ServeOptions,
    composed,
    free_port,
    simulated_arm,
)
from service.server import make_server

PERIOD_S = 1 / 125
EXCLUDED = ("motion", "settling", "exposure", "rendering")
PARTS = ("plan", "command", "reaction", "gate", "record", "bus", "journal", "other")
MEANING = {
    "motion": "the arm moves (said by the controller)",
    "settling": f"{Stillness().samples} packages at rest",
    "exposure": "until the picture's stamp",
    "rendering": "drawing the simulated picture",
    "plan": "ways checked against the limits",
    "command": "checked again, and started by the controller",
    "reaction": "from rest to knowing it, less what moved within `command`",
    "gate": "blur, exposure, depth, movement",
    "record": "compressed, written, flushed, synced",
    "bus": "offered to the feeder",
    "journal": "events, status",
    "other": "between these",
}


class Watched:
    """The stages of a scan as they happen: one row of seconds per waypoint."""

    def __init__(self, controller):
        self.controller = controller
        self.rows = []
        self.recorded_s = []
        self._row = {}
        self._began_s = 0.0
        self._moved_s = 0.0

    @contextmanager
    def __call__(self, name):
        if name == "plan":
            self._row = dict.fromkeys((*EXCLUDED, *PARTS), 0.0)
            self._moved_s = self.controller.do("state")["moving_s"]
            self._began_s = time.perf_counter()
        start_s = time.perf_counter()
        yield
        spent_s = time.perf_counter() - start_s
        row = self._row
        if name == "settle":
            moving_s = self.controller.do("state")["moving_s"]
            self._began_s += time.perf_counter() - start_s - spent_s
            motion_s, self._moved_s = moving_s - self._moved_s, moving_s
            settling_s = Stillness().samples * PERIOD_S
            row["motion"] += motion_s
            row["settling"] += settling_s
            row["reaction"] += spent_s - motion_s - settling_s
        elif name != "grab":
            row[name] += spent_s
        if name == "journal":
            total_s = time.perf_counter() - self._began_s
            row["other"] = total_s - sum(row.values())
            self.rows.append(row)
            self.recorded_s.append(time.perf_counter())

    def grabbed(self, asked_ns, stamp_ns, done_ns):
        self._row["exposure"] += (stamp_ns - asked_ns) / 1e9
        self._row["rendering"] += (done_ns - stamp_ns) / 1e9


class StampedCamera:
    """A camera that says when its picture was exposed and when it was there."""

    def __init__(self, camera, watched):
        self._camera, self._watched = camera, watched
        self.check = camera.check

    def __enter__(self):
        self._camera.__enter__()
        return self

    def __exit__(self, *reasons):
        self._camera.__exit__(*reasons)

    def grab(self, timeout_s):
        asked_ns = time.monotonic_ns()
        image = self._camera.grab(timeout_s)
        self._watched.grabbed(asked_ns, image.stamp_ns, time.monotonic_ns())
        return image


def options_of(argv):
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--views", type=int, choices=(10, 70), default=10)
    parser.add_argument("--time-scale", type=float, default=3.0)
    parser.add_argument("--picture-scale", type=float, default=0.5)
    parser.add_argument("--segmenter", choices=("recorded", "unet"), default="recorded")
    return parser.parse_args(argv)


def main(argv):
    options = options_of(argv)
    with tempfile.TemporaryDirectory() as data, serving(Path(data), options) as (http, watched):
        known_s = scan(http, f"orchard-{options.views}", options.segmenter)
        rows = watched.rows
    print(
        f"{len(rows)} waypoints, arm {options.time_scale:g} times real speed, pictures"
        f" {options.picture_scale:g} of full size, {os.cpu_count()} cores; milliseconds"
    )
    print_rows(rows)
    print_summary(rows)
    behind = [known_s[k] - recorded_s for k, recorded_s in enumerate(watched.recorded_s, start=1)]
    print_line(
        "behind", behind, f"from a view's record to a skeleton with it ({options.segmenter})"
    )


@contextmanager
def serving(data, options):
    watching = []

    @contextmanager
    def hardware(_):
        simulation = prepare(Options(species="apple", leaf_count=500, weather="fair"))
        with FakeUr(free_host(), time_scale=options.time_scale) as controller:
            watching.append(Watched(controller))
            arm = simulated_arm(controller.host)
            sim = SimCamera(lambda: arm.state().pose, simulation, scale=options.picture_scale)
            camera = StampedCamera(sim, watching[0])
            yield Hardware(
                arm=arm,
                camera=camera,
                tool_from_camera=simulation.tool_from_camera,
                limits=SIMULATED_LIMITS,
                paths=SIMULATED_PATHS,
                attachments=lambda _: {},
                stage=watching[0],
            )

    serve = ServeOptions(
        data=data,
        robot=None,
        site="bench",
        rig="rig-1",
        orchard=Options(),
        time_scale=options.time_scale,
        picture_scale=options.picture_scale,
    )
    with composed(serve, hardware) as app:
        port = free_port()
        server = make_server(app, port=port, log_level="warning")
        thread = threading.Thread(target=server.run)
        thread.start()
        try:
            with httpx2.Client(base_url=f"http://127.0.0.1:{port}", timeout=30.0) as http:
                wait_until_ready(http)
                yield http, watching[0]
        finally:
            server.handle_exit(15, None)
            thread.join()


def wait_until_ready(http):
    while True:
        try:
            if all(part["ready"] for part in http.get("/v1/rig").json()["parts"]):
                return
        except httpx2.TransportError:
            pass
        time.sleep(0.2)


def scan(http, path, segmenter):
    """Return when the skeleton first had 1, 2, … views in it."""
    body = {"tree_id": "bench", "path": path, "segmenter": segmenter}
    answer = http.post("/v1/scans", json=body, headers={"Idempotency-Key": "1"})
    answer.raise_for_status()
    where = answer.headers["Location"]
    known_s = {}
    following = threading.Thread(target=follow, args=(http, where, known_s))
    following.start()
    while (status := http.get(where).json())["state"] == "running":
        time.sleep(0.5)
    if status["state"] != "done":
        sys.exit(f"the scan is {status['state']}: {status['detail']}")
    following.join()
    return known_s


def follow(http, where, known_s):
    """Note each skeleton as it comes, until the scan is over and no newer one does."""
    etag, over = "", False
    while True:
        headers = {"Prefer": "wait=2", "If-None-Match": etag, "Accept": "application/json"}
        answer = http.get(f"{where}/skeleton", headers=headers)
        if answer.status_code == 200:
            etag, now_s = answer.headers["ETag"], time.perf_counter()
            for k in range(len(known_s) + 1, answer.json()["views"]["used"] + 1):
                known_s[k] = now_s
        elif over:
            return
        else:
            time.sleep(0.02)
        over = http.get(where).json()["state"] != "running"


def overhead_s(row):
    return sum(row[part] for part in PARTS)


def print_rows(rows):
    names = (*EXCLUDED, *PARTS)
    print("".join(f"{name:>10}" for name in ("waypoint", *names, "overhead")))
    for index, row in enumerate(rows):
        values = [*(row[name] for name in names), overhead_s(row)]
        print(f"{index:>10}" + "".join(f"{1e3 * value:10.1f}" for value in values))


def print_summary(rows):
    print(f"\n{'':12}{'median':>8}{'p90':>8}")
    for name in (*EXCLUDED, *PARTS):
        print_line(name, [row[name] for row in rows], MEANING[name])
    print_line("overhead", [overhead_s(row) for row in rows], "plan to other, together")


def print_line(name, values_s, meaning):
    median, p90 = 1e3 * np.median(values_s), 1e3 * np.percentile(values_s, 90)
    print(f"{name:12}{median:8.1f}{p90:8.1f}  {meaning}")


if __name__ == "__main__":
    main(sys.argv[1:])
