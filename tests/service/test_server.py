import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import httpx2
import jsonschema_rs
import pytest
from live_service import BODY, read_events

ROOT = Path(__file__).parents[2]

SERVE = """
import sys
sys.path[:0] = sys.argv[2:]
from fake_rig import FakeRig
from live_service import PATHS
from service.app import create_app
from service.catalogue import Catalogue
from service.server import listening, make_server

with Catalogue(sys.argv[1]) as catalogue:
    server = make_server(create_app(FakeRig(), catalogue, PATHS))
    server.run(sockets=[listening("127.0.0.1", 0)])
print("cleaned up", flush=True)
"""


@pytest.fixture
def service(tmp_path):
    """A service in a process of its own, and its address."""
    arguments = [sys.executable, "-c", SERVE, tmp_path, ROOT, ROOT / "tests/service"]
    with subprocess.Popen(
        arguments, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        try:
            address = next(
                word for line in process.stderr for word in line.split() if "http://" in word
            )
            yield process, address
        finally:
            process.kill()


@pytest.mark.parametrize("by", [signal.SIGINT, signal.SIGTERM])
def test_the_service_ends_in_time_with_open_streams_and_cleans_up(service, by):
    process, address = service
    assert address.startswith("http://127.0.0.1:")
    with httpx2.Client(base_url=address) as http:
        answer = http.post("/v1/scans", json=BODY, headers={"Idempotency-Key": "k"})
        path = answer.headers["location"]
    opened, ended = threading.Barrier(5), []

    def follow():
        with httpx2.stream("GET", f"{address}{path}/events", timeout=10) as stream:
            events = read_events(stream)
            first = next(events)
            opened.wait(5)
            ended.append([first, *events])

    def wait_for_skeleton():
        opened.wait(5)
        headers = {"Prefer": "wait=30"}
        ended.append(httpx2.get(f"{address}{path}/skeleton", headers=headers).status_code)

    threads = [threading.Thread(target=follow) for _ in range(3)]
    threads.append(threading.Thread(target=wait_for_skeleton))
    for thread in threads:
        thread.start()
    opened.wait(5)
    time.sleep(0.3)
    process.send_signal(by)
    sent_s = time.perf_counter()
    assert process.wait(5) == 0
    assert time.perf_counter() - sent_s < 2
    for thread in threads:
        thread.join(2)
    assert process.stdout.read() == "cleaned up\n"
    log = process.stderr.read()
    assert "Traceback" not in log
    assert len(ended) == 4
    assert [len(one) for one in ended if one != 404] == [1, 1, 1]


OPERATIONS = """
GET /healthz | GET /readyz | GET /metrics
GET /v1/rig | POST /v1/rig:stop | POST /v1/rig:acknowledge
POST /v1/plans | POST /v1/replays | POST /v1/scans | GET /v1/scans | GET /v1/scans/{scan_id}
POST /v1/scans/{scan_id}:pause | POST /v1/scans/{scan_id}:resume | POST /v1/scans/{scan_id}:cancel
GET /v1/scans/{scan_id}/events | GET /v1/scans/{scan_id}/recording.mcap
GET /v1/scans/{scan_id}/views/{index}/color.jpg | GET /v1/scans/{scan_id}/views/{index}/depth.png
GET /v1/scans/{scan_id}/skeleton | GET /v1/scans/{scan_id}/skeleton.{suffix}
GET /v1/scans/{scan_id}/skeleton/nearest | GET /v1/scans/{scan_id}/skeleton/branches
GET /v1/scans/{scan_id}/skeleton/revisions/{revision}
GET /v1/scans/{scan_id}/skeleton/revisions/{revision}.{suffix}
GET /v1/schemas/canopy-skeleton-1.json
"""


def test_the_description_of_the_api_is_valid_and_whole(idle):
    description = idle.http.get("/openapi.json").json()
    assert description["openapi"].startswith("3.")
    operations = {
        f"{method.upper()} {path}": operation
        for path, methods in description["paths"].items()
        for method, operation in methods.items()
    }
    assert set(operations) == {one.strip() for one in OPERATIONS.replace("\n", "|").split("|")} - {
        ""
    }
    schemas = description["components"]["schemas"]
    for schema in schemas.values():
        jsonschema_rs.meta.validate(schema)
    assert not set(references(description)) - set(schemas)
    for operation in operations.values():
        [media_type] = operation["responses"]["default"]["content"]
        assert media_type == "application/problem+json"
    assert schemas["ScanBody"]["additionalProperties"] is False


def references(value):
    """Yield the names of the schemas that a JSON value refers to."""
    if isinstance(value, dict):
        if "$ref" in value:
            yield value["$ref"].removeprefix("#/components/schemas/")
        value = list(value.values())
    if isinstance(value, list):
        for one in value:
            yield from references(one)


def test_the_page_needs_nothing_from_elsewhere(idle):
    page = idle.http.get("/")
    assert page.headers["content-type"].startswith("text/html")
    assert "https://" not in page.text
    assert "http://" not in page.text
    assert "<script" in page.text
