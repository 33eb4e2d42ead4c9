"""The skeleton document `canopy-skeleton/1`: what planners read."""

import json
import math
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from canopy_skel.errors import DocumentError
from canopy_skel.geometry import BoolArray, FloatArray, IntArray
from canopy_skel.graph import SOURCES, SkeletonGraph
from canopy_skel.hierarchy import BranchPath, build_hierarchy
from canopy_skel.schema import SCHEMA_NAME, checked

KINDS = ("trunk", "branch", "twig")
_METRE_DECIMALS = 5
_CONFIDENCE_DECIMALS = 4


@dataclass(frozen=True, kw_only=True, slots=True)
class Branch:
    """One branch, in metres; its first vertex is the parent's vertex it grows from."""

    id: int
    parent: int | None
    order: int
    kind: str
    vertices: tuple[int, ...]
    length: float
    mean_radius: float
    confidence: float


@dataclass(frozen=True, kw_only=True, slots=True)
class Method:
    """How a document was made; `voxel_size_m` None where no map was used (ground truth)."""

    name: str
    voxel_size_m: float | None = None
    config_sha256: str | None = None
    software: str | None = None

    def fields(self) -> dict[str, object]:
        """Return what is known, by name."""
        fields = {name: getattr(self, name) for name in Method.__slots__}
        return {name: value for name, value in fields.items() if value is not None}


@dataclass(frozen=True, kw_only=True, slots=True)
class RejectedView:
    """A view that did not enter the skeleton, and why."""

    index: int
    reason: str


@dataclass(frozen=True, kw_only=True, slots=True)
class MovedView:
    """A view whose reported pose was centimetres off, and how far its wood was moved."""

    index: int
    by_m: float


@dataclass(frozen=True, kw_only=True, eq=False, slots=True)
class SkeletonDocument:
    """A rooted forest in the base frame, metres.

    position: (V, 3); radius, confidence: (V,); occluded: (V,) bool; edges: (E, 2), acyclic,
    partitioned by `branches`, parents before children. root: vertex the main tree grows from,
    None where there is no vertex. preview: joined by a spanning tree, ahead of the search.
    views_alone: indices of views that hardly agree with any other, also if moved by centimetres.
    extra: further per-vertex arrays of the JSON by name, e.g. `segmented` in ground truth.
    """

    scan_id: str
    revision: int
    method: Method
    views_used: int
    views_rejected: tuple[RejectedView, ...]
    position: FloatArray
    radius: FloatArray
    occluded: BoolArray
    confidence: FloatArray
    edges: IntArray
    branches: tuple[Branch, ...]
    root: int | None
    components: int
    preview: bool = False
    views_moved: tuple[MovedView, ...] = ()
    views_alone: tuple[int, ...] = ()
    extra: dict[str, tuple[object, ...]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Freeze the arrays: documents are values."""
        for array in (self.position, self.radius, self.occluded, self.confidence, self.edges):
            array.setflags(write=False)

    def parents(self) -> IntArray:
        """Return (V,) the next vertex toward the root of each vertex; -1 at roots."""
        parent = np.full(len(self.position), -1, dtype=np.int64)
        for branch in self.branches:
            parent[list(branch.vertices[1:])] = branch.vertices[:-1]
        return parent


def build_document(
    graph: SkeletonGraph,
    *,
    scan_id: str,
    revision: int,
    method: Method,
    views_used: int,
    views_rejected: Iterable[RejectedView] = (),
    views_moved: Iterable[MovedView] = (),
    views_alone: Iterable[int] = (),
    preview: bool = False,
) -> SkeletonDocument:
    """Round a skeleton to 0.01 mm, root it, cut it into branches and number its vertices anew.

    The same skeleton gives the same document whatever order its vertices and edges come in.

    Raises:
        ValueError: the graph has a cycle.
    """
    hierarchy = build_hierarchy(_rounded(graph))
    tree = hierarchy.graph
    return SkeletonDocument(
        scan_id=scan_id,
        revision=revision,
        method=method,
        views_used=views_used,
        views_rejected=tuple(views_rejected),
        views_moved=tuple(views_moved),
        views_alone=tuple(views_alone),
        position=tree.vertices_in_base,
        radius=tree.radius_m,
        occluded=tree.occluded,
        confidence=tree.confidence,
        edges=tree.edges,
        branches=tuple(_branch(i, path, tree) for i, path in enumerate(hierarchy.branches)),
        root=0 if len(tree.vertices_in_base) else None,
        components=tree.components()[0],
        extra={}
        if tree.source is None
        else {"source": tuple(SOURCES[code] for code in tree.source.tolist())},
        preview=preview,
    )


def to_json(document: SkeletonDocument) -> bytes:
    """Return the document as UTF-8 JSON, one line per top-level key; same document, same bytes."""
    fields = {
        "schema": SCHEMA_NAME,
        "scan_id": document.scan_id,
        "revision": document.revision,
        "frame": "base",
        "unit": "m",
        "method": document.method.fields(),
        "views": {
            "used": document.views_used,
            "rejected": [{"index": v.index, "reason": v.reason} for v in document.views_rejected],
            **_doubts(document),
        },
        "vertices": {
            "position": _rounded_array(document.position, _METRE_DECIMALS).tolist(),
            "radius": _rounded_array(document.radius, _METRE_DECIMALS).tolist(),
            "occluded": document.occluded.tolist(),
            "confidence": _rounded_array(document.confidence, _CONFIDENCE_DECIMALS).tolist(),
            **{name: list(column) for name, column in sorted(document.extra.items())},
        },
        "edges": document.edges.tolist(),
        "branches": [
            {name: getattr(branch, name) for name in Branch.__slots__}
            for branch in document.branches
        ],
        "root": document.root,
        "components": document.components,
        **({"preview": True} if document.preview else {}),
    }
    lines = (f"{json.dumps(key)}:{_compact(value)}" for key, value in fields.items())
    return ("{" + ",\n ".join(lines) + "}\n").encode()


def _doubts(document: SkeletonDocument) -> dict[str, object]:
    """Return which views were not where they were said to be, if any."""
    doubts: dict[str, object] = {}
    if document.views_moved:
        doubts["moved"] = [
            {"index": v.index, "by_m": round(v.by_m, _METRE_DECIMALS)} for v in document.views_moved
        ]
    if document.views_alone:
        doubts["alone"] = list(document.views_alone)
    return doubts


def from_json(data: bytes, source: str = "skeleton document") -> SkeletonDocument:
    """Read a document; `source` is the file or topic to name when it is wrong.

    Raises:
        DocumentError: not JSON, not what the schema says, or not a forest cut into branches.
    """
    value = checked(_decoded(data, source), source)
    vertices: dict[str, list[Any]] = dict(value["vertices"])
    views = value.get("views", {"used": 0, "rejected": []})
    return SkeletonDocument(
        scan_id=value["scan_id"],
        revision=int(value["revision"]),
        method=Method(**value["method"]),
        views_used=views["used"],
        views_rejected=tuple(RejectedView(**rejected) for rejected in views["rejected"]),
        views_moved=tuple(MovedView(**moved) for moved in views.get("moved", ())),
        views_alone=tuple(views.get("alone", ())),
        position=np.array(vertices.pop("position"), dtype=np.float64).reshape(-1, 3),
        radius=np.array(vertices.pop("radius"), dtype=np.float64),
        occluded=np.array(vertices.pop("occluded"), dtype=np.bool_),
        confidence=np.array(vertices.pop("confidence"), dtype=np.float64),
        edges=np.array(value["edges"], dtype=np.int64).reshape(-1, 2),
        branches=tuple(_read_branch(branch) for branch in value["branches"]),
        root=None if value["root"] is None else int(value["root"]),
        components=int(value["components"]),
        preview=value.get("preview", False),
        extra={name: tuple(column) for name, column in vertices.items()},
    )


def _decoded(data: bytes, source: str) -> object:
    def refuse(constant: str) -> None:
        raise DocumentError(f"{source}: {constant} is no JSON number; write finite numbers only")

    def finite(digits: str) -> float:
        number = float(digits)
        if math.isinf(number):
            raise DocumentError(f"{source}: {digits[:40]} is too large; write finite numbers only")
        return number

    try:
        value: object = json.loads(data, parse_constant=refuse, parse_float=finite)
        _compact(value).encode()  # What is read can be written again.
    except UnicodeEncodeError:
        raise DocumentError(
            f"{source}: a text in it is no Unicode (half a surrogate pair); write it as UTF-8"
        ) from None
    except UnicodeDecodeError as error:
        raise DocumentError(
            f"{source}: not UTF-8 at byte {error.start}; is this a skeleton JSON file?"
        ) from None
    except json.JSONDecodeError as error:
        raise DocumentError(
            f"{source}: not JSON at line {error.lineno}, column {error.colno} ({error.msg});"
            " is the file cut short, or another format?"
        ) from None
    except RecursionError:
        raise DocumentError(f"{source}: nested too deeply; is this a skeleton JSON file?") from None
    except ValueError:
        raise DocumentError(
            f"{source}: holds a whole number of thousands of digits; write indices of vertices"
        ) from None
    return value


def _read_branch(fields: dict[str, Any]) -> Branch:
    """Take a branch over; JSON may write whole numbers as 3.0."""
    return Branch(
        id=int(fields["id"]),
        parent=None if fields["parent"] is None else int(fields["parent"]),
        order=int(fields["order"]),
        kind=fields["kind"],
        vertices=tuple(int(v) for v in fields["vertices"]),
        length=float(fields["length"]),
        mean_radius=float(fields["mean_radius"]),
        confidence=float(fields["confidence"]),
    )


def _branch(index: int, path: BranchPath, tree: SkeletonGraph) -> Branch:
    vertices = list(path.vertices)
    steps_m = np.linalg.norm(np.diff(tree.vertices_in_base[vertices], axis=0), axis=1)
    # Each vertex stands for half of both steps it ends; with no length at all, all count alike.
    weights = np.concatenate([steps_m, [0.0]]) + np.concatenate([[0.0], steps_m])
    if not weights.any():
        weights = np.ones(len(vertices))
    mean_radius = float(np.average(tree.radius_m[vertices], weights=weights))
    confidence = float(np.average(tree.confidence[vertices], weights=weights))
    return Branch(
        id=index,
        parent=path.parent,
        order=path.order,
        kind=KINDS[min(path.order, 2)],
        vertices=path.vertices,
        length=round(float(steps_m.sum()), _METRE_DECIMALS),
        mean_radius=round(mean_radius, _METRE_DECIMALS),
        confidence=round(confidence, _CONFIDENCE_DECIMALS),
    )


def _rounded(graph: SkeletonGraph) -> SkeletonGraph:
    return replace(
        graph,
        vertices_in_base=_rounded_array(graph.vertices_in_base, _METRE_DECIMALS),
        radius_m=_rounded_array(graph.radius_m, _METRE_DECIMALS),
        confidence=_rounded_array(graph.confidence, _CONFIDENCE_DECIMALS),
    )


def _rounded_array(values: FloatArray, decimals: int) -> FloatArray:
    """Round, and turn the negative zeros that rounding leaves into zeros."""
    return np.round(values, decimals) + 0.0


def _compact(value: object) -> str:
    return json.dumps(value, separators=(",", ":"), ensure_ascii=False, allow_nan=False)
