import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from mcap.reader import make_reader

from canopy_skel.document import Method, RejectedView, build_document, from_json, to_json
from canopy_skel.errors import DocumentError
from canopy_skel.graph import SkeletonGraph

RECORDINGS = Path(__file__).parents[2] / "../shared/data/recordings"


def y_shape() -> SkeletonGraph:
    """Return a trunk of two edges, a fork of two, and a loose vertex."""
    return SkeletonGraph(
        vertices_in_base=np.array(
            [
                [1.7, 0.0, 0.0],
                [1.7, 0.0, 0.3],
                [1.7, 0.0, 0.4],
                [1.7, 0.1, 1.0],
                [1.7, -0.2, 0.5],
                [1.2, 0.0, 0.9],
            ]
        ),
        edges=np.array([[0, 1], [1, 2], [2, 3], [2, 4]]),
        radius_m=np.array([0.03, 0.03, 0.02, 0.01, 0.005, 0.004]),
        occluded=np.array([False, True, False, False, False, True]),
        confidence=np.array([1.0, 0.5, 0.9, 0.8, 0.7, 0.2]),
    )


def build(graph: SkeletonGraph):
    return build_document(
        graph,
        scan_id="row 3 – tree 12",
        revision=4,
        method=Method(name="paper", voxel_size_m=0.005, config_sha256="ab12", software="0.1.0"),
        views_used=9,
        views_rejected=[RejectedView(index=3, reason="no pose")],
    )


def empty_graph() -> SkeletonGraph:
    return SkeletonGraph(
        vertices_in_base=np.empty((0, 3)),
        edges=np.empty((0, 2), dtype=np.int64),
        radius_m=np.empty(0),
        occluded=np.empty(0, dtype=np.bool_),
        confidence=np.empty(0),
    )


def test_document_holds_what_the_contract_lists():
    value = json.loads(to_json(build(y_shape())))
    assert value["schema"] == "canopy-skeleton/1"
    assert (value["frame"], value["unit"], value["revision"]) == ("base", "m", 4)
    assert value["scan_id"] == "row 3 – tree 12"
    assert value["method"] == {
        "name": "paper",
        "voxel_size_m": 0.005,
        "config_sha256": "ab12",
        "software": "0.1.0",
    }
    assert value["views"] == {"used": 9, "rejected": [{"index": 3, "reason": "no pose"}]}
    assert value["vertices"]["position"][0] == [1.7, 0.0, 0.0]
    assert value["vertices"]["occluded"] == [False, True, False, False, False, True]
    assert (value["root"], value["components"]) == (0, 2)
    assert [(b["id"], b["parent"], b["order"], b["kind"]) for b in value["branches"]] == [
        (0, None, 0, "trunk"),
        (1, 0, 1, "branch"),
    ]
    assert [b["vertices"] for b in value["branches"]] == [[0, 1, 2, 3], [2, 4]]


def test_branch_numbers_are_weighted_by_length():
    trunk = build(y_shape()).branches[0]
    steps = [0.3, 0.1, float(np.hypot(0.1, 0.6))]
    weights = np.array([steps[0], steps[0] + steps[1], steps[1] + steps[2], steps[2]])
    assert trunk.length == pytest.approx(sum(steps), abs=1e-5)
    assert trunk.mean_radius == pytest.approx(
        np.average([0.03, 0.03, 0.02, 0.01], weights=weights), abs=1e-5
    )
    assert trunk.confidence == pytest.approx(
        np.average([1.0, 0.5, 0.9, 0.8], weights=weights), abs=1e-4
    )


def test_one_line_per_top_level_key():
    lines = to_json(build(y_shape())).decode().splitlines()
    assert len(lines) == len(json.loads("\n".join(lines)))


@pytest.mark.parametrize("graph", [y_shape(), empty_graph()], ids=["y", "empty"])
def test_round_trip_keeps_every_byte(graph):
    data = to_json(build(graph))
    assert to_json(from_json(data)) == data


@given(
    st.lists(
        st.tuples(*[st.floats(-5, 5)] * 3, st.floats(0, 0.2), st.booleans(), st.floats(0, 1)),
        min_size=1,
        max_size=12,
    )
)
def test_what_is_built_equals_what_is_read_back(rows):
    x, y, z, radius, occluded, confidence = zip(*rows, strict=True)
    n = len(rows)
    document = build(
        SkeletonGraph(
            vertices_in_base=np.column_stack([x, y, z]),
            edges=np.array([[i, i + 1] for i in range(n - 1)], dtype=np.int64).reshape(-1, 2),
            radius_m=np.array(radius),
            occluded=np.array(occluded),
            confidence=np.array(confidence),
        )
    )
    read = from_json(to_json(document))
    for name in ("position", "radius", "occluded", "confidence", "edges"):
        assert np.array_equal(getattr(read, name), getattr(document, name)), name
    assert read.branches == document.branches
    assert read.method == document.method
    assert read.views_rejected == document.views_rejected
    assert to_json(read) == to_json(document)


def test_parents_lead_to_the_root():
    assert build(y_shape()).parents().tolist() == [-1, 0, 1, 2, 2, -1]


def test_further_vertex_arrays_are_kept():
    value = json.loads(to_json(build(y_shape())))
    value["vertices"]["segmented"] = [True, False] * 3
    document = from_json(json.dumps(value).encode())
    assert document.extra == {"segmented": (True, False) * 3}
    assert json.loads(to_json(document))["vertices"] == value["vertices"]


def test_loads_without_views_and_with_a_bare_method():
    value = json.loads(to_json(build(y_shape())))
    del value["views"]
    value["method"] = {"name": "ground_truth"}
    document = from_json(json.dumps(value).encode())
    assert (document.views_used, document.views_rejected) == (0, ())
    assert document.method == Method(name="ground_truth")


@pytest.mark.parametrize("name", ["apple_fd2", "oak_fd3", "apple_dense", "walnut_stereo"])
def test_truth_of_the_recordings_loads(name):
    path = RECORDINGS / f"{name}.mcap"
    if not path.exists():
        pytest.skip(f"{path} is not there; the shared recordings are needed")
    with path.open("rb") as stream:
        data = next(make_reader(stream).iter_attachments()).data
    truth = json.loads(data)
    document = from_json(data, source=name)
    assert document.method == Method(name="ground_truth")
    assert document.position.tolist() == truth["vertices"]["position"]
    assert document.extra["segmented"] == tuple(truth["vertices"]["segmented"])
    assert [b.id for b in document.branches] == [b["id"] for b in truth["branches"]]


def set_at(*path):
    """Return a change that sets the value (last argument) at the place (the others)."""
    *keys, last, new = path

    def change(value):
        for key in keys:
            value = value[key]
        value[last] = new

    return change


def drop(key):
    return lambda value: value.pop(key)


BROKEN = {
    "missing field": (drop("edges"), r'"edges" is a required property'),
    "unknown field": (set_at("extra", 1), r"'extra' was unexpected"),
    "other schema": (set_at("schema", "canopy-skeleton/2"), r'schema: .*"canopy-skeleton/1"'),
    "other unit": (set_at("unit", "mm"), r'unit: .*"m"'),
    "text as radius": (set_at("vertices", "radius", 2, "thick"), r"vertices\.radius\[2\]: "),
    "negative radius": (set_at("vertices", "radius", 1, -0.1), r"vertices\.radius\[1\]: -0\.1"),
    "confidence": (set_at("vertices", "confidence", 0, 1.5), r"vertices\.confidence\[0\]: 1\.5"),
    "flat position": (set_at("vertices", "position", 3, [1, 2]), r"vertices\.position\[3\]: "),
    "far off": (
        set_at("vertices", "position", 1, 0, 1e308),
        r"vertices\.position\[1\]\[0\]: 1e\+308",
    ),
    "far below": (set_at("vertices", "position", 1, 2, -1.1e6), r"position\[1\]\[2\]: -1100000"),
    "thick as a hill": (set_at("vertices", "radius", 1, 101), r"vertices\.radius\[1\]: 101"),
    "half a letter": (set_at("scan_id", "\ud800"), r"a text in it is no Unicode"),
    "overflowing": (set_at("vertices", "radius", 0, float("inf")), r"Infinity is no JSON number"),
    "short array": (set_at("vertices", "radius", [0.1]), r"vertices\.radius has 1 .* has 6"),
    "short extra": (set_at("vertices", "leafy", [1]), r"vertices\.leafy has 1 entries"),
    "edge beyond": (set_at("edges", 1, [0, 99]), r"edges\[1\] is \[0, 99\] .* 6 vertices"),
    "huge index": (set_at("edges", 1, [0, 10**40]), r"edges\[1\] is .* 6 vertices"),
    "cycle": (lambda value: value["edges"].append([0, 2]), r"edges: 5 .* cycle"),
    "doubled edge": (lambda value: value["edges"].append([1, 0]), r"edges: 5 .* cycle"),
    "components": (set_at("components", 1), r"components is 1 .* leave 2"),
    "root beyond": (set_at("root", 6), r"root is 6 but there are 6 vertices"),
    "root halfway": (set_at("root", 2), r"root is vertex 2, which a branch leads to"),
    "no root": (set_at("root", None), r"root is null"),
    "kind": (set_at("branches", 0, "kind", "stem"), r"branches\[0\]\.kind: "),
    "branch off an edge": (set_at("branches", 1, "vertices", [2, 5]), r"branches\[1\] uses 2-5"),
    "edge twice": (set_at("branches", 1, "vertices", [2, 3]), r"branches\[1\] uses 2-3"),
    "edge on no branch": (lambda value: value["branches"].pop(), r"edges: 2-4 is on no branch"),
    "unknown parent": (set_at("branches", 1, "parent", 7), r"branches\[1\] starts .* branch 7"),
    "own parent": (set_at("branches", 1, "parent", 1), r"branches\[1\] starts .* branch 1"),
    "id twice": (set_at("branches", 1, "id", 0), r"branches\[1\]\.id 0 is taken"),
    "torn off": (set_at("branches", 1, "parent", None), r"branches\[1\] has no parent but starts"),
    "torn off ahead of what leads there": (
        lambda value: value["branches"].insert(0, {**value["branches"].pop(1), "parent": None}),
        r"branches\[0\] has no parent but starts at vertex 2, which a branch leads to",
    ),
    "inward": (
        lambda value: value["branches"][1].update(vertices=[4, 2], parent=None),
        r"branches\[1\] reaches vertex 2 a second time",
    ),
}


@pytest.mark.parametrize(("change", "message"), BROKEN.values(), ids=BROKEN.keys())
def test_a_broken_document_is_named_in_one_line(change, message):
    value = json.loads(to_json(build(y_shape())))
    change(value)
    with pytest.raises(DocumentError, match=rf"^tree\.json: .*{message}") as caught:
        from_json(json.dumps(value).encode(), source="tree.json")
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 300


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"", "not JSON at line 1"),
        (b'{"schema": ', "not JSON at line 1"),
        (b"glTF\x02\xff\xfe", "not UTF-8 at byte 5"),
        (b"[]", 'not of type "object"'),
        (b'{"revision": NaN}', "NaN is no JSON number"),
        (b'{"revision": 1e400}', "1e400 is too large; write finite"),
        (b"[" * 200_000, "nested too deeply"),
        (b"9" * 5000, "holds a whole number of thousands of digits"),
    ],
)
def test_what_is_no_document_is_named_in_one_line(data, message):
    with pytest.raises(DocumentError, match=rf"^tree\.json: .*{message}") as caught:
        from_json(data, source="tree.json")
    assert "\n" not in str(caught.value)
