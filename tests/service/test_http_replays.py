"""Replays over HTTP: recordings that are sent or that are here, and no arm."""

import json
import socket
from io import BytesIO

import pytest
from fake_rig import DEMO_RECORDING, FakeRig
from live_service import problem, read_events, serving, skeleton, wait_until
from mcap.reader import make_reader
from mcap.writer import Writer
from sqlalchemy.exc import OperationalError

from service.catalogue import Catalogue
from service.http import replays
from service.rig import CAUGHT_UP, NoRoomError

MCAP = {"Content-Type": "application/x-mcap"}
DEMO = DEMO_RECORDING.read_bytes()


COLOR, DEPTH = "/camera/color/image", "/camera/depth/image"
ROS2_NAMES = {
    COLOR: "/camera/color/image_raw",
    DEPTH: "/camera/aligned_depth_to_color/image_raw",
    "/camera/color/calibration": "/camera/color/camera_info",
}


def send(live, content=DEMO, key=None, **asked):
    headers = MCAP | ({} if key is None else {"Idempotency-Key": key})
    return live.http.post("/v1/replays", content=content, headers=headers, params=asked)


def sent(live, **asked):
    """Send the demo recording and return the id of its replay."""
    answer = send(live, **asked)
    assert answer.status_code == 202, answer.text
    return answer.json()["scan_id"]


def status(live, scan_id):
    return live.http.get(f"/v1/scans/{scan_id}").json()


def feed(live, scan_id, views=4, refused=()):
    """Have the worker make a skeleton of some views, and nothing more."""
    if views:
        live.rig.publish(scan_id, skeleton(scan_id, views))
    live.rig.tell(scan_id, CAUGHT_UP, views=4, refused=list(refused))


def scanned(live, key="k1"):
    """Scan once, to the end."""
    scan_id = live.start(key)
    live.rig.photograph(scan_id, 0)
    live.rig.finish(scan_id)
    wait_until(lambda: status(live, scan_id)["state"] == "done")
    return scan_id


def test_a_recording_that_is_sent_becomes_a_scan_that_moves_nothing(live):
    answer = send(live, tree_id="row3-7", method="paper", voxel_size_m="0.01")
    assert answer.status_code == 202
    scan_id = answer.json()["scan_id"]
    assert answer.headers["location"] == f"/v1/scans/{scan_id}"
    told = status(live, scan_id)
    assert (told["kind"], told["state"], told["views_total"]) == ("replay", "running", 4)
    assert live.rig.adopted == {scan_id: DEMO}
    [spec] = live.rig.fed
    assert (spec.scan_id, spec.tree_id, spec.waypoints) == (scan_id, "row3-7", ())
    assert (spec.config.name, spec.config.likelihood.voxel_size_m) == ("paper", 0.01)
    assert spec.segmenter == "recorded"  # it holds masks
    assert live.http.get("/v1/rig").json()["scan"] is None
    live.start("k9")  # the arm is free


def test_it_is_done_when_its_skeleton_is(live):
    scan_id = sent(live)
    with live.http.stream("GET", f"/v1/scans/{scan_id}/events") as stream:
        events = read_events(stream)
        assert next(events)["event"] == "started"
        live.rig.publish(scan_id, skeleton(scan_id, 3))
        assert next(events)["data"]["views_done"] == 3
        feed(live, scan_id)
        assert [event["event"] for event in events] == ["skeleton", CAUGHT_UP, "end"]
    told = status(live, scan_id)
    assert (told["state"], told["views_done"], told["detail"]) == ("done", 4, "")
    answer = live.http.get(f"/v1/scans/{scan_id}/skeleton.json")
    assert answer.content == skeleton(scan_id, 4)


@pytest.mark.parametrize(
    ("views", "refused", "state", "detail"),
    [
        (0, (), "failed", "no view of it is usable"),
        (3, (2,), "failed", "no worker could take views [2]"),
    ],
)
def test_what_was_not_used_is_said(live, views, refused, state, detail):
    scan_id = sent(live)
    feed(live, scan_id, views, refused)
    wait_until(lambda: status(live, scan_id)["state"] == state)
    assert detail in status(live, scan_id)["detail"]


def test_a_preview_is_not_the_end(live):
    scan_id = sent(live)
    preview = json.loads(skeleton(scan_id, 4)) | {"preview": True}
    live.rig.publish(scan_id, json.dumps(preview).encode())
    live.rig.tell(scan_id, CAUGHT_UP, views=4, refused=[3])
    wait_until(lambda: status(live, scan_id)["state"] == "failed")


def test_a_recording_that_is_gone_is_told(live):
    scan_id = sent(live)
    live.rig.tell(scan_id, CAUGHT_UP, views=0, refused=[])
    wait_until(lambda: status(live, scan_id)["state"] == "failed")
    assert status(live, scan_id)["detail"] == "its recording cannot be read any more"


def test_what_a_recording_has_lost_is_said(live):
    told = send(live, DEMO[: len(DEMO) // 2]).json()
    assert "cut off at byte" in told["detail"]
    assert "2 whole views were saved" in told["detail"]
    feed(live, told["scan_id"], 2)
    live.rig.tell(told["scan_id"], CAUGHT_UP, views=2, refused=[])
    wait_until(lambda: status(live, told["scan_id"])["state"] != "running")


def test_an_end_that_cannot_be_noted_is_noted_later(live, monkeypatch):
    monkeypatch.setattr("service.replays._AGAIN_S", 0.05)
    scan_id = sent(live)
    update, faults = Catalogue.update, iter([OperationalError("disk is full", None, Exception())])

    def fails_once(catalogue, now, *more):
        if now.state == "done" and (fault := next(faults, None)):
            raise fault
        update(catalogue, now, *more)

    monkeypatch.setattr(Catalogue, "update", fails_once)
    feed(live, scan_id)
    wait_until(lambda: status(live, scan_id)["state"] == "done")
    assert next(faults, None) is None


def test_the_recording_of_an_ended_scan_is_taken_again(live):
    first = scanned(live)
    answer = live.http.post(
        "/v1/replays", json={"scan_id": first, "method": "mst", "segmenter": "unet"}
    )
    assert answer.status_code == 202, answer.text
    spec = live.rig.fed[-1]
    assert (spec.tree_id, spec.config.name, spec.segmenter) == ("apple-7", "mst", "unet")
    assert spec.scan_id != first
    assert live.rig.adopted == {spec.scan_id: DEMO}
    kinds = [one["kind"] for one in live.http.get("/v1/scans").json()["scans"]]
    assert kinds == ["replay", "scan"]


def test_a_key_is_for_one_request(live):
    one = send(live, key="k1")
    assert send(live, key="k1").json() == one.json()
    problem(send(live, key="k1", method="mst"), 422, "idempotency_key_reused")
    assert len(live.rig.adopted) == 1
    assert sent(live) != sent(live)  # without a key each is another


def test_a_replay_is_cancelled_and_cannot_be_paused(live):
    scan_id = sent(live)
    for verb in ("pause", "resume"):
        problem(live.http.post(f"/v1/scans/{scan_id}:{verb}"), 409, "is_replay")
    assert live.http.post(f"/v1/scans/{scan_id}:cancel").json()["state"] == "cancelled"
    assert live.rig.left == [scan_id]
    feed(live, scan_id)  # what was under way
    ended = sent(live)
    feed(live, ended)
    wait_until(lambda: status(live, ended)["state"] == "done")
    problem(live.http.post(f"/v1/scans/{ended}:cancel"), 409, "scan_over")
    events = live.http.get(f"/v1/scans/{scan_id}/events").text
    assert events.count("cancelled") >= 1
    assert status(live, scan_id)["state"] == "cancelled"
    problem(live.http.post(f"/v1/scans/{scan_id}:cancel"), 409, "scan_over")


def test_a_replay_goes_on_in_the_next_service_and_does_not_hold_the_arm(tmp_path):
    with serving(tmp_path) as live:
        scan_id = sent(live, method="paper")
        ended = sent(live)
        feed(live, ended)
        wait_until(lambda: status(live, ended)["state"] == "done")
    (tmp_path / "uploads/torn.mcap").write_bytes(b"half")
    (tmp_path / "uploads/lost+found").mkdir()
    with serving(tmp_path, FakeRig()) as live:
        assert [file.name for file in (tmp_path / "uploads").iterdir()] == ["lost+found"]
        assert status(live, scan_id)["state"] == "running"
        wait_until(lambda: live.rig.to_catch_up == [scan_id])
        assert live.rig.fed[0].config.name == "paper"
        assert live.rig.holds == []
        feed(live, scan_id)
        wait_until(lambda: status(live, scan_id)["state"] == "done")


def test_an_upload_leaves_nothing_behind(live, tmp_path):
    sent(live)
    problem(send(live, b"no recording"), 422, "unusable_recording")
    before = live.http.get("/v1/scans").json()
    live.rig.refusal = NoRoomError("x.mcap: cannot be written; make room")
    problem(send(live, key="k1"), 507, "no_room")
    assert live.http.get("/v1/scans").json() == before
    assert list((tmp_path / "uploads").iterdir()) == []
    live.rig.refusal = None
    sent(live, key="k1")  # the key was left free


def test_an_upload_that_breaks_off_leaves_nothing(live, tmp_path, caplog):
    address = (live.http.base_url.host, live.http.base_url.port)
    with socket.create_connection(address) as client:
        head = "POST /v1/replays HTTP/1.1\r\nHost: localhost\r\nContent-Length: 1000\r\n"
        client.sendall(f"{head}Content-Type: application/x-mcap\r\n\r\n".encode() + b"half")
        wait_until(lambda: list((tmp_path / "uploads").iterdir()))
    wait_until(lambda: not list((tmp_path / "uploads").iterdir()))
    assert live.rig.adopted == {}
    assert "unexpected error" not in caplog.text


def test_there_must_be_room_for_it_the_first_time(live, monkeypatch):
    first = send(live, key="k1").json()
    monkeypatch.setattr(replays, "ROOM_LEFT_BYTES", 1 << 60)
    problem(send(live), 507, "no_room")
    assert send(live, key="k1").json() == first
    problem(send(live, key="k1", tree_id="another"), 422, "idempotency_key_reused")
    assert len(live.rig.adopted) == 1


def renamed(names, profile="", number=lambda index: index):
    """Return the demo under other names of topics, as another's program may write it.

    number: gives each view another index.
    """
    out = BytesIO()
    writer = Writer(out)
    writer.start(profile=profile)
    channels = {}
    for schema, channel, message in make_reader(BytesIO(DEMO)).iter_messages():
        if channel.id not in channels:
            schema_id = writer.register_schema(schema.name, schema.encoding, schema.data)
            topic = names.get(channel.topic, channel.topic)
            channels[channel.id] = writer.register_channel(
                topic, channel.message_encoding, schema_id
            )
        writer.add_message(
            channels[channel.id],
            message.log_time,
            message.data,
            message.publish_time,
            number(message.sequence),
        )
    writer.finish()
    return out.getvalue()


@pytest.mark.parametrize(
    ("content", "why"),
    [
        (b"", "MCAP"),
        (b"no recording", "MCAP"),
        (renamed({COLOR: "/rgb"}), "no usable camera topic"),
        (renamed({COLOR: DEPTH, DEPTH: COLOR}), "not foxglove.CompressedImage; replay it where"),
        (renamed(ROS2_NAMES, profile="ros2"), "ROS 2 wrote it"),
        (renamed({}, number=lambda index: index // 5), "several views of index 0, 1; number them"),
    ],
)
def test_recordings_that_cannot_be_used_are_refused(idle, content, why):
    refused = problem(send(idle, content), 422, "unusable_recording")
    assert why in refused["detail"]
    assert "uploads" not in refused["detail"]


def test_masks_that_are_not_there_cannot_be_asked_for(live):
    bare = renamed({f"/camera/branches/{name}": name for name in ("instances", "scores")})
    refused = problem(send(live, bare, segmenter="recorded"), 422, "unusable_recording")
    assert "no branch masks" in refused["detail"]
    assert send(live, bare).status_code == 202
    assert live.rig.fed[0].segmenter == "unet"


@pytest.mark.parametrize(
    ("body", "where"),
    [
        ({}, "body.scan_id"),
        ({"scan": "x"}, "body.scan"),
        ({"scan_id": "x", "method": "magic"}, "body.method"),
        ({"scan_id": "x", "method": "paper", "fragments": False}, "body"),
        ([], "body"),
    ],
)
def test_bodies_that_do_not_fit(idle, body, where):
    answer = idle.http.post("/v1/replays", json=body)
    refused = problem(answer, 422, "invalid_request")
    assert where in [one["where"] for one in refused["errors"]]


def test_requests_that_do_not_fit(idle):
    problem(idle.http.post("/v1/replays", json={"scan_id": "none"}), 404, "unknown_scan")
    problem(idle.http.post("/v1/replays", content=b"{"), 422, "invalid_request")
    problem(send(idle, farthest_m="0.1"), 422, "invalid_request")
    problem(send(idle, scan_id="x"), 422, "invalid_request")
    problem(send(idle, key=""), 422, "invalid_request")
    foreign = MCAP | {"Origin": "http://elsewhere.example"}
    answer = idle.http.post("/v1/replays", content=DEMO, headers=foreign)
    problem(answer, 403, "foreign_origin")
    answer = idle.http.post("/v1/replays", content=iter([DEMO]), headers=MCAP)
    problem(answer, 411, "length_required")
    large = {"Content-Type": "application/x-mcap", "Content-Length": str(2 << 20)}
    answer = idle.http.post("/v1/scans", content=bytes(2 << 20), headers=large)
    problem(answer, 413, "content_too_large")
    answer = idle.http.post("/v1/replays", content=bytes(2 << 20))
    assert "application/x-mcap" in problem(answer, 413, "content_too_large")["detail"]


def test_a_scan_under_way_cannot_be_replayed(live):
    scan_id = live.start()
    answer = live.http.post("/v1/replays", json={"scan_id": scan_id})
    problem(answer, 409, "scan_under_way")


def test_metrics_tell_replays_from_scans(live):
    sent(live)
    text = live.http.get("/metrics").text
    assert 'canopy_replays{state="running"} 1.0' in text
    assert 'canopy_scans{state="running"}' not in text


def test_the_schema_names_both_bodies(idle):
    schema = json.loads(idle.http.get("/openapi.json").text)
    route = schema["paths"]["/v1/replays"]["post"]
    assert set(route["requestBody"]["content"]) == {"application/json", "application/x-mcap"}
    assert {"method", "idempotency-key"} <= {one["name"] for one in route["parameters"]}
