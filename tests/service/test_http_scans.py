import json
import socket
import sqlite3
import threading
import time
from contextlib import closing

import httpx2
import numpy as np
import pytest
from fake_rig import FakeRig
from live_service import BODY, PATHS, ask_again, problem, read_events, serving, wait_until

from service.http.requests import SpeedCaps
from service.rig import RigNotReadyError, ScanState


def test_a_scan_is_accepted_and_can_be_looked_at(live):
    answer = live.post_scan(method="mst", voxel_size_m=0.01, retakes=1, speed_mps=0.1)
    scan_id = answer.json()["scan_id"]
    assert answer.status_code == 202
    assert answer.headers["location"] == f"/v1/scans/{scan_id}"
    scan = live.http.get(answer.headers["location"]).json()
    assert (scan["tree_id"], scan["state"], scan["views_total"]) == ("apple-7", "running", 3)
    [spec] = live.rig.specs
    assert (spec.scan_id, spec.speed_mps, spec.acceleration_mps2) == (scan_id, 0.1, 0.5)
    assert (spec.config.name, spec.config.likelihood.voxel_size_m) == ("mst", 0.01)
    assert spec.retakes == 1


def test_waypoints_become_poses_of_the_flange(live):
    quarter_turn = [0.0, 0.0, 2**-0.5, 2**-0.5]
    waypoint = {"position": [0.1, 0.2, 0.3], "quaternion_xyzw": quarter_turn}
    live.start(path=None, waypoints=[waypoint])
    [pose] = live.rig.specs[0].waypoints
    expected = [[0, -1, 0, 0.1], [1, 0, 0, 0.2], [0, 0, 1, 0.3], [0, 0, 0, 1]]
    assert pose == pytest.approx(np.array(expected))


IDENTITY = [0.0, 0.0, 0.0, 1.0]


@pytest.mark.parametrize(
    ("changes", "names"),
    [
        ({"tree_id": None}, "tree_id"),
        ({"tree_id": "../etc"}, "tree_id"),
        ({"tree": "x"}, "tree"),
        ({"method": "magic"}, "method"),
        ({"voxel_size_m": 0}, "voxel_size_m"),
        ({"speed_mps": -1}, "speed_mps"),
        ({"retakes": 1000}, "retakes"),
        ({"path": None}, "either path or waypoints"),
        ({"path": None, "waypoints": []}, "waypoints"),
        (
            {"waypoints": [{"position": [0, 0, 0], "quaternion_xyzw": IDENTITY}]},
            "either path or waypoints",
        ),
        (
            {"path": None, "waypoints": [{"position": [0, 0], "quaternion_xyzw": IDENTITY}]},
            "waypoints.0.position",
        ),
        (
            {"path": None, "waypoints": [{"position": [0, 0, 0], "quaternion_xyzw": [0] * 4}]},
            "unit quaternion",
        ),
    ],
)
def test_a_malformed_body_is_a_problem_that_names_the_place(idle, changes, names):
    body = problem(idle.post_scan(**changes), 422, "invalid_request")
    assert names in json.dumps(body["errors"])
    assert not idle.rig.specs


@pytest.mark.parametrize("number", ["NaN", "Infinity", "1e999"])
def test_numbers_that_are_none_are_refused(idle, number):
    content = f'{{"tree_id": "a", "path": "short", "speed_mps": {number}}}'
    headers = {"Idempotency-Key": "k", "Content-Type": "application/json"}
    problem(idle.http.post("/v1/scans", content=content, headers=headers), 422, "invalid_request")


@pytest.mark.parametrize(
    "content",
    [
        b"{not json",
        b'{"tree_id": "\xff"}',
        b"\xff\xfe{",
        b"[" * 100_000,
        b'{"tree_id": ' + b"1" * 5000 + b"}",
    ],
    ids=["no JSON", "not UTF-8", "not UTF-16", "too deep", "too many digits"],
)
def test_bytes_that_are_no_json_are_refused(idle, content):
    headers = {"Idempotency-Key": "k", "Content-Type": "application/json"}
    answer = idle.http.post("/v1/scans", content=content, headers=headers)
    body = problem(answer, 422, "invalid_request")
    assert body["errors"][0]["where"].startswith("body")
    assert body["errors"][0]["what"]


def test_a_huge_body_is_refused(idle):
    headers = {"Idempotency-Key": "k", "Content-Type": "application/json"}
    body = b" " * (2 << 20)
    answer = idle.http.post("/v1/scans", content=body, headers=headers)
    assert str(1 << 20) in problem(answer, 413, "content_too_large")["detail"]
    in_pieces = (body[i : i + 65536] for i in range(0, len(body), 65536))
    answer = idle.http.post("/v1/scans", content=in_pieces, headers=headers)
    problem(answer, 411, "length_required")


@pytest.mark.parametrize("name", ["speed_mps", "acceleration_mps2"])
def test_speeds_over_the_cap_are_refused_before_the_rig_hears_of_them(tmp_path, name):
    caps = SpeedCaps(speed_mps=0.2, acceleration_mps2=0.2)
    with serving(tmp_path, caps=caps) as live:
        body = problem(live.post_scan(**{name: 0.21}), 422, "plan_refused")
        assert body["detail"] == f"{name} 0.21 is over the cap of 0.2; ask for less"
        assert not live.rig.specs
        live.start(**{name: 0.2})


@pytest.mark.parametrize(
    ("name", "value", "least"),
    [
        ("speed_mps", 1e-300, "0.005"),
        ("speed_mps", 0.0049, "0.005"),
        ("acceleration_mps2", 1e-300, "0.01"),
        ("acceleration_mps2", 0.0099, "0.01"),
    ],
)
@pytest.mark.parametrize("route", ["/v1/plans", "/v1/scans"])
def test_moves_that_would_take_for_ever_are_refused(idle, route, name, value, least):
    body = {"path": "short", name: value} | ({"tree_id": "t"} if route == "/v1/scans" else {})
    answer = idle.http.post(route, json=body, headers={"Idempotency-Key": "slow"})
    detail = problem(answer, 422, "plan_refused")["detail"]
    assert detail == f"{name} {value:g} is under {least}; ask for more"
    assert not idle.rig.specs


def test_an_unknown_path_is_refused_with_those_there_are(idle):
    body = problem(idle.post_scan(path="orchard-11"), 422, "unknown_path")
    assert "choose one of: short" in body["detail"]


def test_refused_waypoints_come_with_the_reason_of_each(idle):
    near, far = ({"position": [x, 0, 0], "quaternion_xyzw": IDENTITY} for x in (0.5, 2.0))
    answer = idle.post_scan(path=None, waypoints=[near, far, near, far])
    body = problem(answer, 422, "plan_refused")
    assert body["waypoints"] == [
        {"index": 1, "reason": "waypoint 1 is out of reach"},
        {"index": 3, "reason": "waypoint 3 is out of reach"},
    ]
    assert idle.http.get("/v1/scans").json()["scans"] == []


def test_a_plan_has_a_verdict_for_every_waypoint_and_moves_nothing(idle):
    near, far = ({"position": [x, 0, 0], "quaternion_xyzw": IDENTITY} for x in (0.5, 2.0))
    plan = idle.http.post("/v1/plans", json={"waypoints": [near, far]}).json()
    assert not plan["feasible"]
    assert [w["reachable"] for w in plan["waypoints"]] == [True, False]
    assert plan["waypoints"][1]["reason"] == "waypoint 1 is out of reach"
    assert idle.http.post("/v1/plans", json={"path": "short"}).json()["feasible"]
    assert not idle.rig.specs


def test_a_second_scan_on_a_busy_arm_is_refused_not_queued(live):
    first = live.start("k1")
    body = problem(live.post_scan("k2"), 409, "rig_busy")
    assert first in body["detail"]
    live.rig.finish(first)
    assert live.start("k2") != first


def test_a_rig_that_is_not_ready_says_why_and_how_to_mend_it(live):
    mend = "the robot is not in remote control; switch it on the pendant"
    live.rig.refusal = RigNotReadyError(mend)
    assert problem(live.post_scan(), 503, "rig_not_ready")["detail"] == mend
    live.rig.refusal = None
    live.start()


def test_what_nobody_foresaw_leaks_nothing(live):
    live.rig.refusal = RuntimeError("password=hunter2")
    answer = live.post_scan()
    body = problem(answer, 500, "internal_error")
    assert "hunter2" not in answer.text
    assert body["trace_id"] in body["detail"]
    [scan] = live.http.get("/v1/scans").json()["scans"]
    assert scan["state"] == "failed"


@pytest.mark.parametrize(
    ("method", "path", "status", "code"),
    [
        ("GET", "/v1/scans/none", 404, "unknown_scan"),
        ("POST", "/v1/scans/none:pause", 404, "unknown_scan"),
        ("POST", "/v1/scans/none:resume", 404, "unknown_scan"),
        ("POST", "/v1/scans/none:cancel", 404, "unknown_scan"),
        ("GET", "/v1/scans/none/events", 404, "unknown_scan"),
        ("GET", "/v1/scans/none/skeleton", 404, "unknown_scan"),
        ("GET", "/v1/scans/none/skeleton.glb", 404, "unknown_scan"),
        ("GET", "/v1/scans/none/recording.mcap", 404, "unknown_scan"),
        ("GET", "/v1/scans/none/views/0/color.jpg", 404, "unknown_scan"),
        ("GET", "/v1/nothing", 404, "not_found"),
        ("DELETE", "/v1/scans", 405, "method_not_allowed"),
        ("GET", "/v1/rig:stop", 405, "method_not_allowed"),
        ("GET", "/v1/scans?limit=0", 422, "invalid_request"),
    ],
)
def test_every_error_is_a_problem(idle, method, path, status, code):
    answer = idle.http.request(method, path)
    problem(answer, status, code)
    if status == 405:
        assert answer.headers["allow"]


def test_the_same_key_and_body_start_one_scan(live):
    first, again = live.post_scan("k1"), live.post_scan("k1")
    assert (again.status_code, again.json()) == (202, first.json())
    assert again.headers["location"] == first.headers["location"]
    live.rig.finish(first.json()["scan_id"])
    assert live.post_scan("k1").json() == first.json()
    assert len(live.rig.specs) == 1


def test_the_same_key_with_another_body_is_refused(live):
    live.start("k1")
    problem(live.post_scan("k1", tree_id="apple-8"), 422, "idempotency_key_reused")


def test_a_key_is_demanded(idle):
    problem(idle.http.post("/v1/scans", json=BODY), 400, "idempotency_key_missing")


def test_requests_at_once_with_one_key_start_one_scan(live):
    answers = []
    threads = [
        threading.Thread(target=lambda: answers.append(live.post_scan("k1"))) for _ in range(8)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert {answer.status_code for answer in answers} == {202}
    assert len({answer.json()["scan_id"] for answer in answers}) == 1
    assert len(live.rig.specs) == 1


def test_pause_resume_cancel(live):
    scan_id = live.start()
    for verb, state in (("pause", "paused"), ("resume", "running"), ("cancel", "cancelled")):
        answer = live.http.post(f"/v1/scans/{scan_id}:{verb}")
        assert (answer.status_code, answer.json()["state"]) == (200, state)
        assert live.http.get(f"/v1/scans/{scan_id}").json()["state"] == state
    problem(live.http.post(f"/v1/scans/{scan_id}:resume"), 409, "scan_over")


def test_pages_of_other_sites_cannot_command_the_rig_but_may_stop_it(live):
    scan_id = live.start()
    foreign = {"Origin": "https://example.org"}
    for path in (f"/v1/scans/{scan_id}:resume", "/v1/rig:acknowledge", "/v1/scans"):
        problem(live.http.post(path, json={}, headers=foreign), 403, "foreign_origin")
    own = {"Origin": live.url}
    assert live.http.post(f"/v1/scans/{scan_id}:pause", headers=own).status_code == 200
    assert live.http.post("/v1/rig:stop", headers=foreign).status_code == 200
    assert live.rig.stops == 1


def test_a_scan_can_be_cancelled_while_it_starts(live, monkeypatch):
    begun, gate, start = threading.Event(), threading.Event(), live.rig.start

    def slow_start(spec):
        begun.set()
        gate.wait(10)
        return start(spec)

    monkeypatch.setattr(live.rig, "start", slow_start)
    starting = threading.Thread(target=live.post_scan)
    starting.start()
    assert begun.wait(5)
    [scan] = live.http.get("/v1/scans").json()["scans"]
    threading.Timer(0.3, gate.set).start()
    answer = live.http.post(f"/v1/scans/{scan['scan_id']}:cancel")
    starting.join()
    assert answer.json()["state"] == "cancelled"
    assert live.rig.status(scan["scan_id"]).state is ScanState.CANCELLED


@pytest.mark.parametrize(
    "headers", [{"Transfer-Encoding": "chunked"}, {"Content-Length": str(1 << 21)}]
)
def test_no_body_keeps_anybody_from_stopping_the_arm(live, headers):
    with socket.create_connection((live.http.base_url.host, live.http.base_url.port)) as wire:
        lines = ["POST /v1/rig:stop HTTP/1.1", "Host: localhost"]
        lines += [f"{name}: {value}" for name, value in headers.items()]
        wire.sendall("\r\n".join([*lines, "", ""]).encode())
        assert b" 200 " in wire.recv(64)
    assert live.rig.stops == 1


def test_stop_and_acknowledge(live):
    assert [live.http.post("/v1/rig:stop").status_code for _ in range(2)] == [200, 200]
    assert live.rig.stops == 2
    problem(live.http.post("/v1/rig:acknowledge", json={"reason": " "}), 422, "invalid_request")
    answer = live.http.post("/v1/rig:acknowledge", json={"reason": "branch removed"})
    assert answer.status_code == 200
    assert live.rig.acknowledged == ["branch removed"]
    live.rig.refusal = RigNotReadyError("still in protective stop; unlock it on the pendant")
    answer = live.http.post("/v1/rig:acknowledge", json={"reason": "branch removed"})
    assert "pendant" in problem(answer, 503, "rig_not_ready")["detail"]


@pytest.mark.parametrize("state", [ScanState.STOPPED, ScanState.FAILED])
def test_a_scan_that_ended_badly_holds_the_arm_beyond_its_own_end_and_the_service(tmp_path, state):
    with serving(tmp_path) as live:
        scan_id = live.start()
        live.rig.become(scan_id, state=state, detail="something unheard of")
        live.rig.tell(scan_id, state.value, detail="something unheard of")
        wait_until(lambda: live.http.get("/v1/scans").json()["scans"][0]["state"] == state)
        live.http.post(f"/v1/scans/{scan_id}:cancel")
    with serving(tmp_path, FakeRig()) as live:
        assert live.rig.holds == ["the arm was stopped before the service was started again"]
        live.http.post("/v1/rig:acknowledge", json={"reason": "looked"})
    with serving(tmp_path, FakeRig()) as live:
        assert live.rig.holds == []


def test_the_end_of_a_scan_that_an_operator_stopped_needs_no_second_acknowledgement(tmp_path):
    with serving(tmp_path) as live:
        scan_id = live.start()
        live.http.post("/v1/rig:stop")
        assert acknowledged(live).status_code == 200
        live.rig.become(scan_id, state=ScanState.STOPPED)
        live.rig.tell(scan_id, "stopped")
        live.http.post(f"/v1/scans/{scan_id}:cancel")
    with serving(tmp_path, FakeRig()) as live:
        assert live.rig.holds == []


def test_a_bad_end_that_is_noted_late_is_acknowledged_too(tmp_path, monkeypatch):
    with serving(tmp_path) as live:
        scan_id = live.start()
        monkeypatch.setattr(live.rig, "skeleton", lambda scan_id: time.sleep(0.2))
        live.rig.photograph(scan_id, 0)  # holds the journal up
        live.rig.become(scan_id, state=ScanState.STOPPED, detail="the camera is gone")
        live.rig.tell(scan_id, "stopped", detail="the camera is gone")
        assert acknowledged(live).status_code == 200
        live.http.post(f"/v1/scans/{scan_id}:cancel")
    with serving(tmp_path, FakeRig()) as live:
        assert live.rig.holds == []


def test_a_stop_without_a_scan_outlives_the_service_until_it_is_acknowledged(tmp_path):
    with serving(tmp_path) as live:
        live.http.post("/v1/rig:stop")
        live.http.post("/v1/rig:stop")
    with serving(tmp_path, FakeRig()) as live:
        assert live.rig.holds == ["the arm was stopped before the service was started again"]
        live.rig.refusal = RigNotReadyError("still in protective stop")
        problem(acknowledged(live), 503, "rig_not_ready")
    with serving(tmp_path, FakeRig()) as live:
        assert len(live.rig.holds) == 1
        assert acknowledged(live).status_code == 200
    with serving(tmp_path, FakeRig()) as live:
        assert live.rig.holds == []


def test_a_stop_during_an_acknowledgement_outlives_the_service(tmp_path, monkeypatch):
    with serving(tmp_path) as live:
        live.http.post("/v1/rig:stop")
        acknowledge = live.rig.acknowledge

        def stopped_meanwhile(reason):
            acknowledge(reason)
            httpx2.post(f"{live.url}/v1/rig:stop")

        monkeypatch.setattr(live.rig, "acknowledge", stopped_meanwhile)
        assert acknowledged(live).status_code == 200
    with serving(tmp_path, FakeRig()) as live:
        assert len(live.rig.holds) == 1


def test_the_arm_is_stopped_even_if_that_cannot_be_noted(tmp_path):
    with serving(tmp_path) as live:
        with closing(sqlite3.connect(tmp_path / "catalogue.sqlite")) as other:
            other.execute(
                "CREATE TRIGGER full BEFORE INSERT ON stops BEGIN SELECT no_such_function(); END"
            )
        assert live.http.post("/v1/rig:stop").status_code == 200
        assert live.rig.stops == 1


def acknowledged(live):
    return live.http.post("/v1/rig:acknowledge", json={"reason": "looked"})


def test_stop_does_not_queue_behind_other_requests(live, monkeypatch):
    gate, waiting = threading.Event(), threading.Semaphore(0)

    def slow_plan(spec):
        waiting.release()
        gate.wait(10)
        return []

    monkeypatch.setattr(live.rig, "plan", slow_plan)
    limits = httpx2.Limits(max_connections=None)
    with httpx2.Client(base_url=live.url, timeout=15, limits=limits) as http:
        body = {"path": "short"}
        plans = [
            threading.Thread(target=http.post, args=("/v1/plans",), kwargs={"json": body})
            for _ in range(60)
        ]
        for thread in plans:
            thread.start()
        for _ in range(40):
            assert waiting.acquire(timeout=5)
        began_s = time.perf_counter()
        assert live.http.post("/v1/rig:stop").status_code == 200
        assert time.perf_counter() - began_s < 1
        assert live.rig.stops == 1
        gate.set()
        for thread in plans:
            thread.join(10)


def test_a_catalogue_that_cannot_be_written_moves_nothing(tmp_path):
    with serving(tmp_path) as live:
        with closing(sqlite3.connect(tmp_path / "catalogue.sqlite")) as other:
            other.execute("DROP TABLE events")
            other.execute("DROP TABLE idempotency")
        problem(live.post_scan(), 503, "catalogue_unavailable")
        assert not live.rig.specs


def test_the_arm_is_commanded_even_if_the_catalogue_cannot_be_written(tmp_path):
    with serving(tmp_path) as live:
        scan_id = live.start()
        with closing(sqlite3.connect(tmp_path / "catalogue.sqlite")) as other:
            other.execute(
                "CREATE TRIGGER full BEFORE UPDATE ON scans BEGIN SELECT no_such_function(); END"
            )
        assert live.http.post(f"/v1/scans/{scan_id}:pause").json()["state"] == "paused"
        assert live.http.get(f"/v1/scans/{scan_id}").json()["state"] == "paused"
        assert live.rig.status(scan_id).state is ScanState.PAUSED


def fill_disk(folder):
    """Let nothing be noted any more, as where there is no room."""
    with closing(sqlite3.connect(folder / "catalogue.sqlite")) as other:
        for name, what in (("full", "UPDATE ON scans"), ("no_room", "INSERT ON events")):
            other.execute(f"CREATE TRIGGER {name} BEFORE {what} BEGIN SELECT full_disk(); END")


def make_room(folder):
    with closing(sqlite3.connect(folder / "catalogue.sqlite")) as other:
        for name in ("full", "no_room"):
            other.execute(f"DROP TRIGGER {name}")


def test_a_scan_whose_end_cannot_be_noted_has_ended(live, tmp_path, monkeypatch):
    monkeypatch.setattr("service.http.scans._LAST_WORDS_UNNOTED_S", 0.2)
    scan_id = live.start()
    live.rig.photograph(scan_id, 0)
    with live.http.stream("GET", f"/v1/scans/{scan_id}/events") as stream:
        events = read_events(stream)
        assert [next(events)["event"] for _ in range(2)] == ["started", "view"]
        fill_disk(tmp_path)
        live.rig.finish(scan_id)
        assert next(events)["event"] == "end"
    assert live.http.get(f"/v1/scans/{scan_id}").json()["state"] == "done"
    assert live.http.get("/v1/rig").json()["scan"] is None
    problem(live.http.post(f"/v1/scans/{scan_id}:cancel"), 409, "scan_over")
    assert live.rig.status(scan_id).state is ScanState.DONE
    make_room(tmp_path)
    assert live.http.post("/v1/replays", json={"scan_id": scan_id}).status_code == 202


def test_an_end_that_cannot_be_noted_at_once_is_noted_when_there_is_room(tmp_path, monkeypatch):
    monkeypatch.setattr("service.replays._AGAIN_S", 0.1)
    with serving(tmp_path) as live:
        scan_id = live.start()
        with live.http.stream("GET", f"/v1/scans/{scan_id}/events") as stream:
            events = read_events(stream)
            assert next(events)["event"] == "started"
            fill_disk(tmp_path)
            live.rig.finish(scan_id)
            wait_until(lambda: live.http.get(f"/v1/scans/{scan_id}").json()["state"] == "done")
            make_room(tmp_path)
            assert [event["event"] for event in events] == ["done", "end"]
    with serving(tmp_path, FakeRig()) as live:
        assert live.http.get(f"/v1/scans/{scan_id}").json()["state"] == "done"
        assert live.rig.holds == []


def test_readiness_names_what_is_missing(live):
    assert live.http.get("/healthz").status_code == 200
    assert live.http.get("/readyz").json()["ready"]
    live.rig.broken_parts["worker"] = ""
    ready = live.http.get("/readyz")
    assert ready.status_code == 200
    worker = next(part for part in ready.json()["parts"] if part["name"] == "worker")
    assert not worker["ready"]
    assert "pending" in worker["detail"]
    live.rig.broken_parts["camera"] = "no OAK device; plug it in"
    body = problem(live.http.get("/readyz"), 503, "not_ready")
    assert body["detail"] == "camera: no OAK device; plug it in"
    assert len(body["parts"]) == 4
    assert live.http.get("/healthz").status_code == 200


def test_the_rig_shows_parts_paths_caps_and_the_scan_under_way(live):
    assert live.http.get("/v1/rig").json()["scan"] is None
    scan_id = live.start()
    rig = live.http.get("/v1/rig").json()
    assert rig["scan"]["scan_id"] == scan_id
    assert rig["paths"] == {name: len(path) for name, path in PATHS.items()}
    assert rig["caps"] == {"speed_mps": 0.25, "acceleration_mps2": 0.5}


def test_scans_are_listed_newest_first_page_by_page(live):
    started = []
    for i in range(5):
        started.append(live.start(f"k{i}"))
        live.rig.finish(started[-1])
    listed, before = [], None
    while True:
        params = {"limit": 2} | ({"before": before} if before else {})
        page = live.http.get("/v1/scans", params=params).json()
        listed += [scan["scan_id"] for scan in page["scans"]]
        before = page["next"]
        if before is None:
            break
    assert listed == started[::-1]


@pytest.mark.parametrize("before", ["nonesuch", ""])
def test_a_list_before_an_unknown_scan_is_refused(idle, before):
    answer = idle.http.get("/v1/scans", params={"before": before})
    assert repr(before) in problem(answer, 404, "unknown_scan")["detail"]


def test_a_repeated_start_after_a_crash_moves_nothing(tmp_path):
    with serving(tmp_path) as live:
        scan_id = live.start("k1")
    with serving(tmp_path, FakeRig()) as live:
        assert live.post_scan("k1").json()["scan_id"] == scan_id
        assert live.rig.specs == []


def test_a_scan_of_an_earlier_life_waits_for_an_operator_and_goes_on(tmp_path):
    with serving(tmp_path) as live:
        scan_id = live.start("k1", speed_mps=0.125)
        [first] = live.rig.specs
        live.rig.photograph(scan_id, 0)
    with serving(tmp_path, FakeRig()) as live:
        scan = live.http.get(f"/v1/scans/{scan_id}").json()
        assert scan["state"] == "stopped"
        assert "resume or cancel" in scan["detail"]
        live.rig.refusal = RigNotReadyError("acknowledge first")
        problem(live.http.post(f"/v1/scans/{scan_id}:resume"), 503, "rig_not_ready")
        live.rig.refusal = None
        answer = live.http.post(f"/v1/scans/{scan_id}:resume")
        assert (answer.json()["state"], answer.json()["views_done"]) == ("running", 1)
        [spec] = live.rig.specs
        assert (spec.scan_id, spec.speed_mps) == (first.scan_id, first.speed_mps)
        assert all((a == b).all() for a, b in zip(spec.waypoints, first.waypoints, strict=True))


def test_a_scan_of_an_earlier_life_goes_on_as_slowly_as_it_was_asked_for_then(tmp_path):
    with serving(tmp_path) as live:
        scan_id = live.start()
    ask_again(tmp_path, scan_id, speed_mps=0.004)
    with serving(tmp_path, FakeRig()) as live:
        assert live.http.post(f"/v1/scans/{scan_id}:resume").status_code == 200
        assert [spec.speed_mps for spec in live.rig.specs] == [0.004]


def test_a_scan_of_an_earlier_life_can_be_cancelled(tmp_path):
    with serving(tmp_path) as live:
        scan_id = live.start()
    with serving(tmp_path, FakeRig()) as live:
        answer = live.http.post(f"/v1/scans/{scan_id}:cancel")
        assert answer.json()["state"] == "cancelled"
        assert live.http.get(f"/v1/scans/{scan_id}").json()["state"] == "cancelled"
