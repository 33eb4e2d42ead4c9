import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from live_service import problem, skeleton, wait_until

from canopy_skel.document import Method, build_document
from canopy_skel.graph import SkeletonGraph
from service.http.planners import nearest_point

COORDINATE = st.floats(-2, 2)


@pytest.fixture
def pole(live):
    """A scan whose skeleton is an upright pole of 1 m over the origin."""
    live.scan_id = live.start()
    live.path = f"/v1/scans/{live.scan_id}/skeleton"
    live.rig.publish(live.scan_id, skeleton(live.scan_id, 3))
    wait_until(lambda: live.http.get(live.path).status_code == 200)
    return live


def test_the_nearest_wood_and_whether_it_was_seen(pole):
    answer = pole.http.get(f"{pole.path}/nearest", params={"x": 0.3, "y": 0.0, "z": 0.75})
    assert answer.json() == {
        "revision": 3,
        "position": [0.0, 0.0, 0.75],
        "distance_m": 0.3,
        "radius_m": pytest.approx(0.015),
        "occluded": False,
        "confidence": 1.0,
        "branch": 0,
        "vertices": [1, 2],
    }


def test_a_planner_asks_for_wood_that_is_sure(pole):
    asked = {"x": 0.3, "y": 0.0, "z": 0.75, "min_confidence": 1.0}
    assert pole.http.get(f"{pole.path}/nearest", params=asked).json()["distance_m"] == 0.3
    document = json.loads(skeleton(pole.scan_id, 4))
    document["vertices"]["confidence"] = [0.9] * 3
    pole.rig.publish(pole.scan_id, json.dumps(document).encode())
    wait_until(lambda: pole.http.get(pole.path).headers["canopy-revision"] == "4")
    refused = problem(pole.http.get(f"{pole.path}/nearest", params=asked), 404, "no_such_wood")
    assert "revision 4 has no wood of confidence 1 or more" in refused["detail"]
    asked["min_confidence"] = 1.1
    problem(pole.http.get(f"{pole.path}/nearest", params=asked), 422, "invalid_request")


def test_branches_say_where_they_begin_and_end(pole):
    (trunk,) = pole.http.get(f"{pole.path}/branches").json()["branches"]
    assert (trunk["kind"], trunk["parent"], trunk["length"]) == ("trunk", None, 1.0)
    assert sorted([trunk["start"], trunk["end"]]) == [[0, 0, 0], [0, 0, 1]]


def test_without_a_skeleton_or_a_point_there_is_a_problem(live):
    scan_id = live.start()
    path = f"/v1/scans/{scan_id}/skeleton"
    problem(live.http.get(f"{path}/nearest?x=0&y=0&z=0"), 404, "skeleton_pending")
    problem(live.http.get(f"{path}/branches"), 404, "skeleton_pending")
    problem(live.http.get(f"{path}/nearest?x=0&y=0"), 422, "invalid_request")
    problem(live.http.get(f"{path}/nearest?x=0&y=0&z=nan"), 422, "invalid_request")
    problem(live.http.get("/v1/scans/none/skeleton/nearest?x=0&y=0&z=0"), 404, "unknown_scan")


@pytest.mark.parametrize("x", ["1e308", "-1000001", "inf"])
def test_a_point_that_is_nowhere_near_is_refused(pole, x):
    body = problem(pole.http.get(f"{pole.path}/nearest?x={x}&y=0&z=0"), 422, "invalid_request")
    assert body["errors"][0]["where"] == "query.x"
    assert pole.http.get(f"{pole.path}/nearest?x=-1e6&y=1e6&z=0").json()["distance_m"] > 1e6


@given(st.lists(st.tuples(COORDINATE, COORDINATE, COORDINATE), min_size=2, max_size=12), st.data())
def test_no_point_of_the_centre_lines_is_nearer(vertices, data):
    count = len(vertices)
    parents = [data.draw(st.integers(0, i - 1)) for i in range(1, count)]
    graph = SkeletonGraph(
        vertices_in_base=np.array(vertices),
        edges=np.column_stack([parents, range(1, count)]),
        radius_m=np.full(count, 0.01),
        occluded=np.zeros(count, dtype=np.bool_),
        confidence=np.array([data.draw(st.sampled_from([0.3, 0.8])) for _ in range(count)]),
    )
    document = build_document(
        graph,
        scan_id="s",
        revision=1,
        method=Method(name="paper", voxel_size_m=0.005),
        views_used=1,
    )
    point = np.array(data.draw(st.tuples(COORDINATE, COORDINATE, COORDINATE)))
    sure = data.draw(st.sampled_from([0.0, 0.5, 0.9]))
    found = nearest_point(document, point, sure)
    edges = document.edges[(document.confidence[document.edges] >= sure).all(axis=1)]
    if found is None:
        assert len(edges) == 0
        return
    assert found.confidence >= sure
    assert found.distance_m == pytest.approx(np.linalg.norm(point - found.position), abs=1e-9)
    a, b = document.position[edges].transpose(1, 0, 2)
    samples = np.concatenate([a + share * (b - a) for share in np.linspace(0, 1, 30)])
    assert found.distance_m <= np.linalg.norm(samples - point, axis=1).min() + 1e-9
    assert set(found.vertices) <= set(document.branches[found.branch].vertices)


def test_metrics_count_scans_events_and_parts(pole):
    pole.rig.broken_parts["worker"] = "start one"
    text = pole.http.get("/metrics").text
    assert 'canopy_part_ready{part="arm"} 1.0' in text
    assert 'canopy_part_ready{part="worker"} 0.0' in text
    assert 'canopy_scans{state="running"} 1.0' in text
    assert 'canopy_events_total{kind="skeleton"} 1.0' in text
