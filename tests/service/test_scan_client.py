import threading
from contextlib import ExitStack

import pytest
from fake_rig import FakeRig
from live_service import BODY, serving, skeleton, wait_until

from service.rig import RigNotReadyError, ScanState
from service.scan_client import RefusedError, ScanClient, UnreachableServiceError, scan


def drive(live, views, *, last_skeleton_late_s=0.0):
    """Have the rig run a scan as soon as one is started."""

    def run():
        spec = wait_until(lambda: live.rig.specs and live.rig.specs[-1])
        for index in range(views):
            live.rig.photograph(spec.scan_id, index)
            if index < views - 1:
                live.rig.publish(spec.scan_id, skeleton(spec.scan_id, index + 1))
        live.rig.finish(spec.scan_id)
        document = skeleton(spec.scan_id, views)
        threading.Timer(last_skeleton_late_s, live.rig.publish, (spec.scan_id, document)).start()

    thread = threading.Thread(target=run)
    thread.start()
    return thread


def test_a_scan_from_start_to_skeleton(live):
    thread = drive(live, 3, last_skeleton_late_s=1.0)
    events = []
    result = scan(live.url, BODY, events.append)
    thread.join()
    assert [e.kind for e in events if e.kind != "skeleton"] == ["started", *["view"] * 3, "done"]
    assert [e.fields["index"] for e in events if e.kind == "view"] == [0, 1, 2]
    assert (result.status.state, result.status.views_done) == (ScanState.DONE, 3)
    assert result.skeleton == skeleton(result.status.scan_id, 3)
    assert result.complete


def test_a_scan_without_a_worker_ends_without_a_skeleton(live):
    started = threading.Event()

    def run():
        started.wait(5)
        live.rig.photograph(live.rig.specs[0].scan_id, 0)
        live.rig.finish(live.rig.specs[0].scan_id)

    thread = threading.Thread(target=run)
    thread.start()
    result = scan(live.url, BODY, lambda event: started.set(), skeleton_timeout_s=1.0)
    thread.join()
    assert (result.skeleton, result.complete) == (None, False)
    assert result.status.state is ScanState.DONE


def test_a_refusal_says_what_and_why(live):
    live.rig.refusal = RigNotReadyError("the robot is powered off; press on")
    with pytest.raises(RefusedError, match="used now: the robot is powered off") as caught:
        scan(live.url, BODY, print)
    assert (caught.value.status, caught.value.code) == (503, "rig_not_ready")


def test_refused_waypoints_are_told(live):
    far = {"position": [2, 0, 0], "quaternion_xyzw": [0, 0, 0, 1]}
    with pytest.raises(RefusedError) as caught:
        scan(live.url, {"tree_id": "t", "waypoints": [far]}, print)
    reasons = [waypoint["reason"] for waypoint in caught.value.more["waypoints"]]
    assert reasons == ["waypoint 0 is out of reach"]


def test_a_service_that_is_not_there_is_named():
    with pytest.raises(UnreachableServiceError, match=r"127\.0\.0\.1:9.*canopy serve"):
        scan("http://127.0.0.1:9", BODY, print, patience_s=0.5)


def test_following_goes_on_across_a_restart_of_the_service(tmp_path):
    kinds = []
    with ExitStack() as first_life, ExitStack() as second_life:
        live = first_life.enter_context(serving(tmp_path))
        port = int(live.url.rsplit(":", 1)[1])
        with ScanClient(live.url) as client:
            scan_id = client.start(BODY, "k")
            events = client.follow(scan_id)
            kinds.append(next(events).kind)
            first_life.close()
            again = second_life.enter_context(serving(tmp_path, FakeRig(), port=port))
            kinds.append(next(events).kind)
            assert client.status(scan_id).state is ScanState.STOPPED
            assert client.cancel(scan_id).state is ScanState.CANCELLED
            assert client.start(BODY, "k") == scan_id
            assert again.rig.specs == []
            kinds.extend(event.kind for event in events)
    assert kinds == ["started", "interrupted", "cancelled"]
