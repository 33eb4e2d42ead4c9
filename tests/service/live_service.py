"""A service on a free port, in this process, and documents for it to serve."""

import json
import socket
import sqlite3
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass

import httpx2
import numpy as np
from fake_rig import FakeRig

from canopy_skel.document import Method, MovedView, build_document, to_json
from canopy_skel.graph import SkeletonGraph
from service.app import create_app
from service.catalogue import Catalogue
from service.server import make_server

POSE = np.eye(4)
PATHS = {"short": [POSE, POSE, POSE]}
BODY = {"tree_id": "apple-7", "path": "short"}


@dataclass
class Live:
    url: str
    rig: FakeRig
    http: httpx2.Client

    def start(self, key: str = "k1", **changes: object) -> str:
        """Start a scan and return its id."""
        answer = self.post_scan(key, **changes)
        assert answer.status_code == 202, answer.text
        return answer.json()["scan_id"]

    def post_scan(self, key: str = "k1", **changes: object) -> httpx2.Response:
        body = {name: v for name, v in (BODY | changes).items() if v is not None}
        return self.http.post("/v1/scans", json=body, headers={"Idempotency-Key": key})


@contextmanager
def serving(
    folder, rig: FakeRig | None = None, *, port: int = 0, **options: object
) -> Iterator[Live]:
    rig = rig or FakeRig()
    with Catalogue(folder) as catalogue, socket.create_server(("127.0.0.1", port)) as bound:
        app = create_app(rig, catalogue, PATHS, **options)
        server = make_server(app, log_level="warning")
        thread = threading.Thread(target=server.run, kwargs={"sockets": [bound]})
        thread.start()
        url = f"http://127.0.0.1:{bound.getsockname()[1]}"
        try:
            wait_until(lambda: server.started)
            with httpx2.Client(base_url=url, timeout=10) as http:
                yield Live(url, rig, http)
        finally:
            server.handle_exit(0, None)
            thread.join(10)
        assert not thread.is_alive()


def ask_again(folder, scan_id: str, **changes: object):
    """Change what a scan of the catalogue was asked for, as another version may have noted it."""
    with closing(sqlite3.connect(folder / "catalogue.sqlite")) as catalogue:
        for name, value in changes.items():
            catalogue.execute(
                "UPDATE scans SET request = json_set(request, ?, ?) WHERE scan_id = ?",
                [f"$.{name}", value, scan_id],
            )
        catalogue.commit()


def wait_until(condition, timeout_s: float = 5.0):
    """Return the first true value of `condition()`."""
    until_s = time.perf_counter() + timeout_s
    while not (value := condition()):
        assert time.perf_counter() < until_s, "it did not happen in time"
        time.sleep(0.01)
    return value


def skeleton(
    scan_id: str,
    revision: int,
    length_m: float = 1.0,
    *,
    moved: Sequence[MovedView] = (),
    alone: Sequence[int] = (),
) -> bytes:
    """Return the document of a bare pole."""
    graph = SkeletonGraph(
        vertices_in_base=np.array([[0.0, 0, 0], [0, 0, length_m / 2], [0, 0, length_m]]),
        radius_m=np.array([0.03, 0.02, 0.01]),
        occluded=np.zeros(3, dtype=np.bool_),
        confidence=np.ones(3),
        edges=np.array([[0, 1], [1, 2]]),
    )
    return to_json(
        build_document(
            graph,
            scan_id=scan_id,
            revision=revision,
            method=Method(name="paper", voxel_size_m=0.005),
            views_used=revision,
            views_moved=moved,
            views_alone=alone,
        )
    )


def problem(answer, status, code):
    """Check that an answer is a whole problem document and return it."""
    assert answer.status_code == status, answer.text
    assert answer.headers["content-type"] == "application/problem+json"
    body = answer.json()
    assert body["status"] == status
    assert body["code"] == code
    assert body["type"] == f"urn:canopy:problem:{code}"
    assert body["instance"] == answer.url.path
    assert body["title"]
    assert body["detail"]
    return body


def read_events(stream: httpx2.Response) -> Iterator[dict]:
    """Yield the events of an SSE stream as {"event", "id", "data"}."""
    fields: dict = {}
    for line in stream.iter_lines():
        name, _, value = line.partition(": ")
        if not line and fields:
            yield fields
            fields = {}
        elif name:
            fields[name] = json.loads(value) if name == "data" else value
