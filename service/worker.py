"""The worker process: views in from the bus, skeletons out.

`python -m service.worker --connect tcp/127.0.0.1:PORT --site SITE --rig RIG [--id ID]`

Three threads: zenoh's, which only moves samples into a queue (and answers queries); one that works;
one that says twice a second how far it is. The worker keeps nothing that the recording does not
hold: it may be killed at any moment, and the service sends again what it lacks.
"""

import argparse
import logging
import os
import queue
import signal
import sys
import threading
import time
from collections import OrderedDict
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from typing import NoReturn

import cv2
import zenoh

from canopy_skel.errors import CanopyError
from canopy_skel.messages import encode_json
from canopy_skel.pipeline import METHODS
from service.bus import ENCODING_JSON, ENCODING_PROBLEM, Keys, open_session
from service.envelope import ViewEnvelope, decode_envelope
from service.heartbeat import PERIOD_S, SCANS_KEPT, Heartbeat, Version
from service.kernels import compile_kernels
from service.live import LiveSkeleton, warm_up
from service.memory import keep_freed_memory
from service.skeletons import SEGMENTERS

_log = logging.getLogger(__name__)


class Worker:
    """Turns the views of one rig into skeletons, one scan after the other.

    Args:
        session: an open bus session.
        keys: of the rig.
        worker_id: its name on the bus.
    """

    def __init__(self, session: zenoh.Session, keys: Keys, worker_id: str) -> None:
        self._session, self._keys = session, keys
        self._inbox: queue.SimpleQueue[bytes] = queue.SimpleQueue()
        self._scans: OrderedDict[str, LiveSkeleton] = OrderedDict()  # the work thread's alone
        self._documents: dict[str, tuple[Version, bytes]] = {}
        self._lock = threading.Lock()  # of the documents: queries read them
        self._heartbeat = Heartbeat(id=worker_id, pid=os.getpid())
        self._in_hand = False
        self._patient_until_s = 0.0
        self._progress = 0
        self._stop = threading.Event()

    @contextmanager
    def running(self) -> Iterator[None]:
        """Work in the background; the worker is warm and says so when this is entered."""
        warm_up(self._stage)
        # Held until the session is closed, which undeclares them within its time limit.
        declared = (
            self._session.declare_subscriber(self._keys.views, self._receive),
            self._session.declare_queryable(self._keys.skeletons, self._answer, complete=True),
            self._session.liveliness().declare_token(self._keys.worker(self._heartbeat.id)),
        )
        for target in (self._work, self._beat):
            threading.Thread(target=target, name=target.__name__, daemon=True).start()
        try:
            yield
        finally:
            self._stop.set()
            del declared

    def _receive(self, sample: zenoh.Sample) -> None:
        """Never do more here: a slow callback stalls the link, and a stalled link loses samples."""
        self._inbox.put(sample.payload.to_bytes())

    def _answer(self, query: zenoh.Query) -> None:
        """Answer a query for one scan, or for several by a pattern, with the latest documents."""
        asked = query.key_expr
        with self._lock:
            documents = {self._keys.skeleton(one): found for one, found in self._documents.items()}
        found = {key: one for key, one in documents.items() if asked.intersects(key)}
        for key, (version, data) in found.items():
            query.reply(key, data, encoding=ENCODING_JSON, attachment=version.encode())
        if not found:
            problem = {
                "type": "about:blank",
                "title": "no such skeleton",
                "status": 404,
                "detail": f"{asked}: the worker has no usable view of this scan",
            }
            query.reply_err(encode_json(problem), encoding=ENCODING_PROBLEM)
        query.drop()

    def _work(self) -> NoReturn:
        while True:
            data = self._inbox.get()
            self._in_hand = True
            self._guarded(partial(self._take, data))
            if self._inbox.empty() or time.monotonic() >= self._patient_until_s:
                self._guarded(self._publish)
            self._in_hand = False
            self._say()

    def _guarded(self, step: Callable[[], None]) -> None:
        """Do a step; the process outlives whatever a sample does to it, and says so."""
        try:
            step()
        except CanopyError as error:
            self._complain(str(error))
        except Exception as error:
            if not self._stop.is_set():
                _log.exception("a sample could not be worked on")
                self._complain(f"a sample could not be worked on ({error!r}); see the worker's log")

    def _complain(self, problem: str) -> None:
        _log.error("%s", problem)
        self._heartbeat = replace(self._heartbeat, problem=problem)

    def _take(self, data: bytes) -> None:
        envelope = decode_envelope(data)
        scan = self._scan(envelope)
        try:
            scan.add(envelope)
        except Exception as error:
            # It would only fail again when it is sent again.
            scan.reject(envelope.view, f"view {envelope.view}: the method failed on it ({error!r})")
            raise
        finally:
            self._acknowledge(envelope, scan)

    def _scan(self, envelope: ViewEnvelope) -> LiveSkeleton:
        """Return the scan of an envelope; a new one, or one with a new method, starts anew."""
        scan_id = envelope.scan_id
        scan = self._scans.get(scan_id)
        if scan is None or not scan.fits(envelope):
            scan = LiveSkeleton(scan_id, envelope.config, envelope.segmenter, self._stage)
            self._scans[scan_id] = scan
            self._forget(scan_id)
            self._heartbeat = replace(self._heartbeat, problem="")
        self._scans.move_to_end(scan_id)
        while len(self._scans) > SCANS_KEPT:
            self._forget(self._scans.popitem(last=False)[0])
        return scan

    def _forget(self, scan_id: str) -> None:
        with self._lock:
            self._documents.pop(scan_id, None)

    def _acknowledge(self, envelope: ViewEnvelope, scan: LiveSkeleton) -> None:
        self._heartbeat = replace(
            self._heartbeat,
            scan_id=envelope.scan_id,
            config_sha256=envelope.config.sha256(),
            views=scan.views,
            rejected=scan.rejected,
            revision=len(scan.views),
        )
        self._say()

    def _publish(self) -> None:
        """Publish the skeleton of every scan that has grown since its last one, the newest first.

        While views are waiting, at most half of the time goes into skeletons, and previews do.
        """
        start_s, exact = time.monotonic(), self._inbox.empty()
        for scan_id, scan in reversed(self._scans.items()):
            version = Version(revision=len(scan.views), rejected=len(scan.rejected), exact=exact)
            known, _ = self._documents.get(scan_id, (Version(), b""))
            data = scan.document(preview=not exact) if version.order > known.order else None
            if data is None:
                continue
            with self._lock:
                self._documents[scan_id] = (version, data)
            self._session.put(
                self._keys.skeleton(scan_id),
                data,
                encoding=ENCODING_JSON,
                attachment=version.encode(),
                congestion_control=zenoh.CongestionControl.BLOCK,
            )
        self._patient_until_s = 2 * time.monotonic() - start_s

    @contextmanager
    def _stage(self, name: str) -> Iterator[None]:
        yield
        self._progress += 1

    def _beat(self) -> None:
        while not self._stop.is_set():
            self._say()
            self._stop.wait(PERIOD_S)

    def _say(self) -> None:
        busy = self._in_hand or not self._inbox.empty()
        heartbeat = replace(self._heartbeat, busy=busy, progress=self._progress)
        try:
            self._session.put(
                self._keys.worker(heartbeat.id), heartbeat.encode(), encoding=ENCODING_JSON
            )
        except zenoh.ZError as error:
            if not self._stop.is_set():
                _log.warning("a heartbeat could not be sent: %s", error)


def main(arguments: Sequence[str]) -> NoReturn:
    """Run a worker until SIGTERM or SIGINT, or until its parent is gone."""
    options = _parser().parse_args(arguments)
    logging.basicConfig(level=logging.INFO, format="%(levelname)s %(name)s: %(message)s")
    cv2.setNumThreads(1)  # arm, bus and browser keep the other cores
    keep_freed_memory()
    stop = threading.Event()
    _on_signals(sys.exit)  # compiling kernels takes its time, and its processes end with this one
    try:
        keys = Keys(site=options.site, rig=options.rig)
        keys.worker(options.id)
        compile_kernels((*METHODS, *SEGMENTERS))
        _on_signals(lambda: _leave(0))  # nothing to close yet, and warming up takes its time
        with (
            open_session(connect=options.connect) as session,
            Worker(session, keys, options.id).running(),
        ):
            _on_signals(stop.set)
            _log.info("worker %s is ready at %s", options.id, options.connect)
            while not stop.wait(PERIOD_S) and options.parent in (None, os.getppid()):
                pass
    except CanopyError as error:
        _leave(2, f"error: {error}\n")
    _leave(0)


def _on_signals(leave: Callable[[], None]) -> None:
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: leave())


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m service.worker", description=main.__doc__)
    parser.add_argument("--connect", required=True, help="bus endpoint, e.g. tcp/127.0.0.1:7447")
    parser.add_argument("--site", required=True)
    parser.add_argument("--rig", required=True)
    parser.add_argument("--id", default="1", help="name of this worker on the bus")
    parser.add_argument("--parent", type=int, help="leave when this process is no longer my parent")
    return parser


def _leave(code: int, last_words: str = "") -> NoReturn:
    """End at once: the view in hand may take seconds more, and the recording has it."""
    sys.stderr.write(last_words)
    sys.stderr.flush()
    os._exit(code)


if __name__ == "__main__":
    main(sys.argv[1:])
