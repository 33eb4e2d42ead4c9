"""A scan, its recording as it grows, and the two ends of a bus with a real worker process."""

import os
import signal
import socket
import subprocess
import sys
import time
from contextlib import ExitStack, suppress
from itertools import count
from pathlib import Path

import numpy as np
from scenes.wood import view_from

from canopy_skel.pipeline import MethodConfig
from canopy_skel.recording import RecordingWriter
from service.bus import Keys, open_session
from service.feeder import ViewFeeder
from service.offered import ScanSource
from service.replay import ReplayRequest, replay

ROOT = Path(__file__).parents[2]
POSES = [(0.1 * (i % 5) - 0.2, 0.1 * (i // 5)) for i in range(10)]


def free_port():
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def wait_for(condition, timeout_s=20.0):
    end = time.monotonic() + timeout_s
    while not (found := condition()):
        assert time.monotonic() < end, "waited in vain"
        time.sleep(0.02)
    return found


def scan_views(unusable=()):
    """Ten views of the wood; those named as unusable carry no instances."""
    without = {"instances": None, "scores": None}
    return [
        view_from(i, y=y, z=z, stamp_ns=1_000 * (i + 1), **(without if i in unusable else {}))
        for i, (y, z) in enumerate(POSES)
    ]


class Rig:
    """A service side with a feeder, and workers that can be started and killed."""

    site_and_rig = ("--site", "orchard", "--rig", "arm-1")
    keys = Keys(site="orchard", rig="arm-1")

    def __init__(self, folder, session=lambda session: session):
        self._wrap = session
        self.folder = folder
        self.endpoint = f"tcp/127.0.0.1:{free_port()}"
        self.documents = []
        self.caught_up = []
        self._stack = ExitStack()
        self._workers = []
        self._numbers = count(1)

    def __enter__(self):
        self.session = self._stack.enter_context(open_session(listen=self.endpoint))
        self.feeder = self._stack.enter_context(
            ViewFeeder(
                self._wrap(self.session),
                self.keys,
                lambda *found: self.documents.append(found[:2]),
                lambda *told: self.caught_up.append(told),
            )
        )
        return self

    def __exit__(self, *error):
        for worker in self._workers:
            if worker.poll() is None:
                worker.send_signal(signal.SIGCONT)
                worker.kill()
            worker.wait()
        self._stack.close()

    def start_worker(self, *arguments):
        command = [sys.executable, "-m", "service.worker", "--connect", self.endpoint]
        with (self.folder / "worker.log").open("ab") as log:
            worker = subprocess.Popen(
                [*command, *self.site_and_rig, *arguments], cwd=ROOT, stderr=log
            )
        self._workers.append(worker)
        return worker

    def start_ready_worker(self):
        worker = self.start_worker()
        wait_for(lambda: self.feeder.worker_status().ready, 60)
        return worker

    @property
    def log(self):
        return (self.folder / "worker.log").read_text()

    def scan(self, **changes):
        """Begin a further scan and return the writer of its recording, not yet entered."""
        self.scan_id = name = f"scan-{next(self._numbers)}"
        self.documents.clear()
        self.feeder.begin(self.source(name, **changes))
        path = self.folder / f"{name}.mcap"
        return RecordingWriter(path, {"scan_id": name}, tool_from_camera=np.eye(4))

    def source(self, name, **changes):
        """Return what a feeder must know of a scan."""
        path = self.folder / f"{name}.mcap"
        part = path.with_name(path.name + ".part")
        source = {
            "scan_id": name,
            "config": MethodConfig(),
            "segmenter": "recorded",
            "recording": lambda: path if path.exists() else part,
        }
        return ScanSource(**(source | changes))

    def replayed(self, config=None, name=None):
        """Return the bytes that a replay of a recording gives, by default of the last."""
        name = name or self.scan_id
        request = ReplayRequest(
            config=config or MethodConfig(),
            segmenter="recorded",
            formats=("json",),
            topics=None,
            memory_limit_bytes=3 << 30,
        )
        out = self.folder / f"{name}-replayed"
        out.mkdir(exist_ok=True)
        replay(self.folder / f"{name}.mcap", out, request, lambda done, total: None)
        return (out / f"{name}.skeleton.json").read_bytes()


def listening_addresses(pid):
    """Return address and port of every socket on which a process waits for others."""
    mine = set()
    for link in Path(f"/proc/{pid}/fd").iterdir():
        with suppress(OSError):
            mine.add(os.readlink(link))
    found = []
    for protocol in ("tcp", "tcp6", "udp", "udp6"):
        for line in Path(f"/proc/{pid}/net/{protocol}").read_text().splitlines()[1:]:
            local, state, inode = (line.split()[i] for i in (1, 3, 9))
            waits = state == "0A" if protocol.startswith("tcp") else state == "07"
            if waits and f"socket:[{inode}]" in mine:
                address, port = local.split(":")
                octets = bytes.fromhex(address)[::-1]
                name = ".".join(map(str, octets)) if len(octets) == 4 else address
                found.append((name, int(port, 16)))
    return found
