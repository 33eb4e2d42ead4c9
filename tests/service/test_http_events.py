from fake_rig import FakeRig
from live_service import problem, read_events, serving, skeleton

from service.rig import ScanState


def test_events_come_live_and_end_with_the_scan(live):
    scan_id = live.start()
    received = []
    with live.http.stream("GET", f"/v1/scans/{scan_id}/events") as stream:
        assert stream.headers["content-type"].startswith("text/event-stream")
        for event in read_events(stream):
            received.append(event)
            if event["event"] == "started":
                live.rig.photograph(scan_id, 0)
            if event["event"] == "view":
                live.rig.publish(scan_id, skeleton(scan_id, 1))
            if event["event"] == "skeleton":
                assert live.http.get(f"/v1/scans/{scan_id}/skeleton").status_code == 200
                live.rig.finish(scan_id)
    assert [event["event"] for event in received] == ["started", "view", "skeleton", "done", "end"]
    assert [event.get("id") for event in received] == ["1", "2", "3", "4", None]
    assert received[1]["data"]["views_done"] == 1
    assert received[1]["data"]["fields"] == {"index": 0}
    assert received[3]["data"]["state"] == "done"


def test_events_resume_after_the_last_one_seen_also_in_another_life(tmp_path):
    with serving(tmp_path) as live:
        scan_id = live.start()
        for index in range(3):
            live.rig.photograph(scan_id, index)
        live.rig.finish(scan_id)
    with serving(tmp_path, FakeRig()) as live:
        path = f"/v1/scans/{scan_id}/events"
        with live.http.stream("GET", path, headers={"Last-Event-ID": "2"}) as stream:
            events = list(read_events(stream))
        assert [event["event"] for event in events] == ["view", "view", "done", "end"]
        assert [event["data"]["fields"] for event in events[:2]] == [{"index": 1}, {"index": 2}]
        for unknown in ("x", str(2**63)):
            answer = live.http.get(path, headers={"Last-Event-ID": unknown})
            problem(answer, 422, "invalid_request")


def test_events_that_no_json_holds_do_not_stop_the_journal(live):
    scan_id = live.start()
    live.rig.tell(scan_id, "odd", path=ScanState, number=float("nan"))
    live.rig.tell("no-such-scan", "view")
    live.rig.finish(scan_id)
    with live.http.stream("GET", f"/v1/scans/{scan_id}/events") as stream:
        kinds = [event["event"] for event in read_events(stream)]
    assert kinds == ["started", "odd", "done", "end"]
