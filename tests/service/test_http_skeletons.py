import hashlib
import json
import os
import re
import sqlite3
import threading
import time
from contextlib import closing

import cv2
import httpx2
import numpy as np
import pytest
from fake_rig import DEMO_RECORDING, FakeRig
from live_service import ask_again, problem, serving, skeleton, wait_until

from canopy_skel.document import from_json
from canopy_skel.exports import FORMATS
from canopy_skel.recording import read_recording
from canopy_skel.schema import schema_text
from service.http.negotiation import best_media_type, wait_s
from service.http.skeletons import MEDIA_TYPES
from service.rig import CAUGHT_UP, PlanRefusedError
from service.specs import spec_from


def with_two_revisions(live):
    """Start a scan that has revisions 1 and 2."""
    live.scan_id = live.start()
    live.path = f"/v1/scans/{live.scan_id}/skeleton"
    live.first, live.second = (skeleton(live.scan_id, n, length_m=n) for n in (1, 2))
    for document in (live.first, live.second):
        live.rig.publish(live.scan_id, document)
        wait_until(lambda document=document: live.http.get(live.path).content == document)
    return live


@pytest.fixture(scope="module")
def scan(idle):
    """A scan with revisions 1 and 2 that nobody changes."""
    return with_two_revisions(idle)


@pytest.fixture
def growing(live):
    """A scan with revisions 1 and 2 that goes on."""
    return with_two_revisions(live)


def test_a_skeleton_is_pending_until_there_is_one(live):
    scan_id = live.start()
    answer = live.http.get(f"/v1/scans/{scan_id}/skeleton")
    assert (answer.status_code, answer.json()["code"]) == (404, "skeleton_pending")
    assert answer.headers["retry-after"] == "2"
    assert "no worker" not in answer.json()["detail"]
    live.rig.broken_parts["worker"] = "start `canopy worker`"
    answer = live.http.get(f"/v1/scans/{scan_id}/skeleton")
    assert "no worker: start `canopy worker`" in answer.json()["detail"]


@pytest.mark.parametrize("name", MEDIA_TYPES)
def test_every_format_by_suffix_and_by_accept(scan, name):
    assert set(MEDIA_TYPES) == set(FORMATS)
    expected = FORMATS[name](from_json(scan.second))
    by_suffix = scan.http.get(f"{scan.path}.{name}")
    by_accept = scan.http.get(scan.path, headers={"Accept": MEDIA_TYPES[name]})
    for answer in (by_suffix, by_accept):
        assert answer.content == expected
        assert answer.headers["content-type"].split(";")[0] == MEDIA_TYPES[name]
        assert answer.headers["etag"] == f'"{hashlib.sha256(expected).hexdigest()}"'
        assert answer.headers["cache-control"] == "no-cache"
        assert answer.headers["vary"] == "Accept"
    old = scan.http.get(f"{scan.path}/revisions/1.{name}")
    assert old.content == FORMATS[name](from_json(scan.first))


def test_json_is_served_byte_for_byte(scan):
    assert scan.http.get(scan.path).content == scan.second
    assert scan.http.get(f"{scan.path}/revisions/1").content == scan.first


def test_validators_spare_the_transfer(scan):
    answer = scan.http.get(scan.path)
    etag = answer.headers["etag"]
    for listed in (etag, f'"other", W/{etag}', "*"):
        again = scan.http.get(scan.path, headers={"If-None-Match": listed})
        assert (again.status_code, again.content) == (304, b"")
        assert again.headers["etag"] == etag
    assert scan.http.get(scan.path, headers={"If-None-Match": '"other"'}).status_code == 200
    glb = {"If-None-Match": etag, "Accept": "model/gltf-binary"}
    assert scan.http.get(scan.path, headers=glb).status_code == 200


def test_all_revisions_but_the_newest_are_final(growing):
    first, second = (growing.http.get(f"{growing.path}/revisions/{n}") for n in (1, 2))
    assert "immutable" in first.headers["cache-control"]
    assert second.headers["cache-control"] == "no-cache"
    rejected = json.loads(growing.second)
    rejected["views"]["rejected"] = [{"index": 2, "reason": "blurred"}]
    corrected = json.dumps(rejected).encode()
    growing.rig.publish(growing.scan_id, corrected)
    wait_until(lambda: growing.http.get(growing.path).content == corrected)
    assert growing.http.get(f"{growing.path}/revisions/2").content == corrected


def test_a_worker_that_starts_over_does_not_take_the_skeleton_back(growing):
    growing.rig.publish(growing.scan_id, growing.first)
    growing.rig.finish(growing.scan_id)
    wait_until(lambda: growing.http.get(f"/v1/scans/{growing.scan_id}").json()["state"] == "done")
    assert growing.http.get(growing.path).content == growing.second


def test_what_there_is_not(scan):
    for path, code in (("/revisions/9", "unknown_revision"), (".obj", "unknown_format")):
        answer = scan.http.get(f"{scan.path}{path}")
        assert (answer.status_code, answer.json()["code"]) == (404, code)
    answer = scan.http.get(scan.path, headers={"Accept": "image/png"})
    assert (answer.status_code, answer.json()["code"]) == (406, "not_acceptable")
    for path in (f"/revisions/{2**63}", f"/revisions/{2**63}.json"):
        answer = scan.http.get(f"{scan.path}{path}")
        assert (answer.status_code, answer.json()["code"]) == (422, "invalid_request")


def test_a_planner_waits_for_the_first_and_for_the_next_skeleton(live):
    scan_id = live.start()
    path, etag = f"/v1/scans/{scan_id}/skeleton", ""
    for revision in (1, 2):
        document = skeleton(scan_id, revision, length_m=revision)
        publisher = threading.Timer(0.4, live.rig.publish, (scan_id, document))
        publisher.start()
        asked_s = time.perf_counter()
        headers = {"Prefer": "respond-async, wait=5", "If-None-Match": etag}
        answer = live.http.get(path, headers=headers)
        assert (answer.status_code, answer.content) == (200, document)
        assert answer.headers["preference-applied"] == "wait=5"
        assert 0.3 < time.perf_counter() - asked_s < 2
        etag = answer.headers["etag"]
        publisher.join()
    answer = live.http.get(path, headers={"Prefer": "wait=1", "If-None-Match": etag})
    assert answer.status_code == 304


def test_skeletons_outlive_the_service(tmp_path):
    with serving(tmp_path) as live:
        scan_id = live.start()
        live.rig.publish(scan_id, document := skeleton(scan_id, 1))
    with serving(tmp_path, FakeRig()) as live:
        assert live.http.get(f"/v1/scans/{scan_id}/skeleton").content == document


def finished(live, key, *documents):
    """Scan three views, of which came these documents (bytes of a scan id); return the id."""
    scan_id = live.start(key)
    for index in range(3):
        live.rig.photograph(scan_id, index)
    for document in documents:
        live.rig.publish(scan_id, document(scan_id))
    live.rig.finish(scan_id)
    path = f"/v1/scans/{scan_id}"
    wait_until(lambda: live.http.get(path).json()["state"] == "done")
    events = live.http.get(f"{path}/events").text  # it ends when all is noted
    assert "event: done" in events
    return scan_id


def preview(scan_id):
    return json.dumps(json.loads(skeleton(scan_id, 3)) | {"preview": True}).encode()


def without_one(scan_id):
    """A skeleton of two views and the reason why it is not of three."""
    document = json.loads(skeleton(scan_id, 2))
    document["views"]["rejected"] = [{"index": 2, "reason": "dark"}]
    return json.dumps(document).encode()


def to_catch_up(live):
    """What the rig was asked to catch up on, once the service has looked through its scans."""
    wait_until(lambda: "catch up" not in {thread.name for thread in threading.enumerate()})
    return live.rig.to_catch_up


def test_scans_without_the_skeleton_of_all_their_views_are_caught_up_on_by_the_next_service(
    tmp_path,
):
    with serving(tmp_path) as live:
        finished(live, "whole", lambda scan_id: skeleton(scan_id, 3))
        lacking = [
            finished(live, "two of three", lambda scan_id: skeleton(scan_id, 2)),
            finished(live, "none"),
            finished(live, "a preview", preview),
        ]
        finished(live, "one is rejected", without_one)
        torn = finished(live, "torn", lambda scan_id: skeleton(scan_id, 3, length_m=2.0))
        under_way = live.start("under way")
        sha256 = hashlib.sha256(skeleton(torn, 3, length_m=2.0)).hexdigest()
    (tmp_path / "skeletons" / f"{sha256}.json").write_bytes(b"{")
    with serving(tmp_path, FakeRig()) as live:
        assert to_catch_up(live) == [*lacking, torn, under_way]


def test_replays_do_not_keep_scans_from_being_caught_up_on(tmp_path, monkeypatch):
    monkeypatch.setattr("service.incomplete.LOOK_BACK", 1)
    with serving(tmp_path) as live:
        scan_id = finished(live, "k1")
        replay = live.http.post("/v1/replays", json={"scan_id": scan_id}).json()["scan_id"]
    with serving(tmp_path, FakeRig()) as live:
        assert to_catch_up(live) == [scan_id, replay]


@pytest.mark.parametrize(
    ("end", "times"),
    [
        ({"views": 3, "refused": []}, 1),
        ({"views": 3, "refused": [1]}, 3),
        ({"views": 2}, 3),
        ({"views": 0}, 3),
    ],
)
def test_a_recording_that_gives_no_whole_skeleton_is_not_fed_for_ever(tmp_path, end, times):
    with serving(tmp_path) as live:
        scan_id = finished(live, "k1")
    with serving(tmp_path, FakeRig()) as live:  # no worker comes meanwhile
        assert to_catch_up(live) == [scan_id]
    for _ in range(times):
        with serving(tmp_path, FakeRig()) as live:
            assert to_catch_up(live) == [scan_id]
            live.rig.tell(scan_id, CAUGHT_UP, **({"refused": []} | end))
    with serving(tmp_path, FakeRig()) as live:
        assert to_catch_up(live) == []


def test_a_request_that_cannot_be_read_any_more_does_not_keep_the_service_from_starting(tmp_path):
    with serving(tmp_path) as live:
        strange, good = finished(live, "k1"), finished(live, "k2")
    with closing(sqlite3.connect(tmp_path / "catalogue.sqlite")) as catalogue:
        catalogue.execute("UPDATE scans SET request = '{}' WHERE scan_id = ?", [strange])
        catalogue.commit()
    with serving(tmp_path, FakeRig()) as live:
        assert to_catch_up(live) == [good]


@pytest.mark.parametrize("refusal", [None, PlanRefusedError("too slow to be meant")])
def test_a_scan_asked_for_under_other_bounds_keeps_no_other_from_being_caught_up_on(
    tmp_path, monkeypatch, refusal
):
    with serving(tmp_path) as live:
        slow, usual = finished(live, "k1"), finished(live, "k2")
    ask_again(tmp_path, slow, speed_mps=0.004, acceleration_mps2=0.001)

    def read(scan_id, fields):
        if refusal is not None and scan_id == slow:
            raise refusal
        return spec_from(scan_id, fields)

    monkeypatch.setattr("service.incomplete.spec_from", read)
    with serving(tmp_path, FakeRig()) as live:
        assert to_catch_up(live) == ([slow, usual] if refusal is None else [usual])


def test_the_schema_is_served(idle):
    answer = idle.http.get("/v1/schemas/canopy-skeleton-1.json")
    assert answer.text == schema_text()


@pytest.mark.parametrize(
    ("accept", "chosen"),
    [
        ("*/*", "a/json"),
        ("", None),
        ("b/glb", "b/glb"),
        ("a/json;q=0.5, b/glb", "b/glb"),
        ("*/*;q=0.1, B/*", "b/glb"),
        ("a/json;q=0, */*", "b/glb"),
        ("a/json;q=x", None),
        ("c/d", None),
    ],
)
def test_accept(accept, chosen):
    assert best_media_type(accept, ["a/json", "b/glb"]) == chosen


@pytest.mark.parametrize(
    ("prefer", "seconds"),
    [("wait=7", 7), ("wait = 7", 7), ("a; wait=7", 7), ("wait=999", 60), ("wait=-1", 0), ("", 0)],
)
def test_prefer(prefer, seconds):
    assert wait_s(prefer) == seconds


@pytest.fixture(scope="module", params=["whole", "growing"])
def recorded(request, tmp_path_factory):
    """A service whose rig has the demo's recording, finished or cut as by a scan under way."""
    folder = tmp_path_factory.mktemp("recorded")
    path = folder / "scan.mcap"
    content = DEMO_RECORDING.read_bytes()
    if request.param == "whole":
        path.write_bytes(content)
    else:
        path.with_name("scan.mcap.part").write_bytes(content[: len(content) * 2 // 3])
    with serving(folder / "state", FakeRig(recording=path)) as live:
        live.base = f"/v1/scans/{live.start()}"
        yield live


def test_pictures_are_those_of_the_recording(recorded):
    view = next(read_recording(DEMO_RECORDING).views())
    color = recorded.http.get(f"{recorded.base}/views/{view.index}/color.jpg")
    assert color.headers["content-type"] == "image/jpeg"
    bgr = cv2.imdecode(np.frombuffer(color.content, np.uint8), cv2.IMREAD_COLOR)
    assert np.array_equal(bgr[:, :, ::-1], view.color_rgb)
    depth = recorded.http.get(f"{recorded.base}/views/{view.index}/depth.png")
    assert depth.headers["content-type"] == "image/png"
    depth_mm = cv2.imdecode(np.frombuffer(depth.content, np.uint8), cv2.IMREAD_UNCHANGED)
    assert depth_mm.dtype == np.uint16
    assert np.array_equal(depth_mm, np.nan_to_num(view.depth_m * 1000).round())


def test_a_view_that_is_not_recorded_is_named(recorded):
    answer = recorded.http.get(f"{recorded.base}/views/99/color.jpg")
    assert (answer.status_code, answer.json()["code"]) == (404, "no_picture")
    assert "view 99" in answer.json()["detail"]


def test_the_recording_can_be_downloaded_in_ranges(recorded):
    answer = recorded.http.get(f"{recorded.base}/recording.mcap")
    assert DEMO_RECORDING.read_bytes().startswith(answer.content)
    part = recorded.http.get(f"{recorded.base}/recording.mcap", headers={"Range": "bytes=8-15"})
    assert (part.status_code, part.content) == (206, answer.content[8:16])


@pytest.mark.parametrize(
    ("asked", "status", "expected"),
    [
        ("bytes=0-0", 206, slice(0, 1)),
        ("bytes=100-", 206, slice(100, None)),
        ("bytes=-7", 206, slice(-7, None)),
        ("bytes=5-999999999999", 206, slice(5, None)),
        ("bytes=9-5", 200, slice(None)),
        ("bytes=-", 200, slice(None)),
        ("bytes=0-1,4-5", 200, slice(None)),
        ("pages=1-2", 200, slice(None)),
    ],
)
def test_ranges_are_those_that_were_asked_for(recorded, asked, status, expected):
    url = f"{recorded.base}/recording.mcap"
    content = recorded.http.get(url).content
    answer = recorded.http.get(url, headers={"Range": asked})
    assert (answer.status_code, answer.content) == (status, content[expected])
    if status == 206:
        first, last, size = map(int, re.findall(r"\d+", answer.headers["content-range"]))
        assert (content[first : last + 1], size) == (answer.content, len(content))


@pytest.mark.parametrize("asked", ["bytes=999999999999-", "bytes=-0"])
def test_a_range_that_is_not_there_is_a_problem(recorded, asked):
    url = f"{recorded.base}/recording.mcap"
    answer = recorded.http.get(url, headers={"Range": asked})
    problem(answer, 416, "range_not_satisfiable")
    assert answer.headers["content-range"] == f"bytes */{len(recorded.http.get(url).content)}"


def test_a_range_of_a_recording_that_has_changed_is_not_given(recorded):
    url = f"{recorded.base}/recording.mcap"
    etag = recorded.http.get(url).headers["etag"]
    for if_range, status in ((etag, 206), ('"another"', 200)):
        headers = {"Range": "bytes=8-15", "If-Range": if_range}
        assert recorded.http.get(url, headers=headers).status_code == status


def test_a_recording_that_grows_during_the_download_comes_as_it_was(tmp_path):
    part = tmp_path / "scan.mcap.part"
    with part.open("wb") as stream:
        stream.truncate(32 << 20)  # more than fits between server and client
        stream.seek(0, os.SEEK_END)
        stream.write(b"the end")
    before = part.read_bytes()
    with serving(tmp_path / "state", FakeRig(recording=part)) as live:
        url = f"{live.url}/v1/scans/{live.start()}/recording.mcap"
        with httpx2.stream("GET", url) as answer:
            with part.open("ab") as stream:
                stream.write(b"x" * 1000)
            part.rename(tmp_path / "scan.mcap")
            assert answer.read() == before


def test_a_recording_that_is_finished_just_now_is_found(tmp_path, monkeypatch):
    part, whole = tmp_path / "scan.mcap.part", tmp_path / "scan.mcap"
    part.write_bytes(b"all of it")
    access = os.access

    def finished_after(path, mode):
        found = access(path, mode)
        if path == part and found:
            part.rename(whole)
        return found

    with serving(tmp_path / "state", FakeRig(recording=part)) as live:
        scan_id = live.start()
        monkeypatch.setattr("service.pictures.os.access", finished_after)
        answer = live.http.get(f"/v1/scans/{scan_id}/recording.mcap")
        assert (answer.status_code, answer.content) == (200, b"all of it")


def test_what_was_recorded_is_there_while_a_scan_that_goes_on_copies_it(tmp_path):
    copy = tmp_path / "scan.mcap.part"
    content = DEMO_RECORDING.read_bytes()
    copy.write_bytes(content)
    with serving(tmp_path / "state", FakeRig(recording=copy)) as live:
        base = f"/v1/scans/{live.start()}"
        picture = live.http.get(f"{base}/views/0/color.jpg").content
        copy.rename(tmp_path / "scan.mcap.aside")
        for copied in (b"", content[:1000]):
            assert live.http.get(f"{base}/views/0/color.jpg").content == picture
            assert live.http.get(f"{base}/recording.mcap").content == content
            copy.write_bytes(copied)


def test_pictures_come_as_the_recording_grows(tmp_path):
    part = tmp_path / "scan.mcap.part"
    with serving(tmp_path / "state", FakeRig(recording=tmp_path / "scan.mcap")) as live:
        base = f"/v1/scans/{live.start()}"
        for path in ("views/0/color.jpg", "recording.mcap"):
            assert live.http.get(f"{base}/{path}").status_code == 404
        content = DEMO_RECORDING.read_bytes()
        part.write_bytes(content[:1000])
        assert live.http.get(f"{base}/views/0/color.jpg").status_code == 404
        part.write_bytes(content[:-100])
        picture = live.http.get(f"{base}/views/0/color.jpg").content
        part.rename(tmp_path / "scan.mcap")
        assert live.http.get(f"{base}/views/0/color.jpg").content == picture
