"""What makes a JSON value a skeleton document: the shipped schema, and what no schema can say."""

import json
from functools import cache
from importlib import resources
from itertools import pairwise
from typing import Any, cast

import jsonschema_rs
import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from canopy_skel.errors import DocumentError

SCHEMA_NAME = "canopy-skeleton/1"
_SCHEMA_FILE = "schemas/canopy-skeleton-1.schema.json"


@cache
def schema_text() -> str:
    """Return the JSON Schema (2020-12) of the document, as it is served and shipped."""
    return resources.files("canopy_skel").joinpath(_SCHEMA_FILE).read_text(encoding="utf-8")


@cache
def _validator() -> jsonschema_rs.Draft202012Validator:
    return jsonschema_rs.Draft202012Validator(json.loads(schema_text()))


def checked(value: object, source: str) -> dict[str, Any]:
    """Return a decoded JSON value once schema, indices, graph and branches are right.

    Args:
        value: what `json.loads` gave.
        source: file or topic it came from, for the message.

    Raises:
        DocumentError: one line with the source, the first place that is wrong, and the mend.
    """
    for error in _validator().iter_errors(value):
        place = _place(error.instance_path)
        raise DocumentError(
            f"{source}: {place}{_short(error.message)}; mend it as the JSON Schema"
            f" of {SCHEMA_NAME} says"
        )
    document = cast(dict[str, Any], value)
    try:
        vertex_count = _check_vertices(document["vertices"])
        _check_graph(document, vertex_count)
        _check_branches(document)
    except DocumentError as error:
        raise DocumentError(f"{source}: {error}") from None
    return document


def _place(path: list[str | int]) -> str:
    text = "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in path)
    return f"{text.removeprefix('.')}: " if text else ""


def _short(message: str) -> str:
    return message if len(message) <= 160 else f"{message[:70]} … {message[-80:]}"


def _check_vertices(vertices: dict[str, list[Any]]) -> int:
    count = len(vertices["position"])
    for name, column in vertices.items():
        if len(column) != count:
            raise DocumentError(
                f"vertices.{name} has {len(column)} entries but vertices.position has {count};"
                " give one per vertex"
            )
    return count


def _check_graph(value: dict[str, Any], vertex_count: int) -> None:
    for i, edge in enumerate(value["edges"]):
        if max(edge) >= vertex_count:
            raise DocumentError(
                f"edges[{i}] is {edge} but there are only {vertex_count} vertices;"
                f" use indices below {vertex_count}"
            )
    edges = np.array(value["edges"], dtype=np.int64).reshape(-1, 2)
    if vertex_count and not 0 <= (-1 if value["root"] is None else value["root"]) < vertex_count:
        raise DocumentError(
            f"root is {json.dumps(value['root'])} but there are {vertex_count} vertices;"
            " name the vertex the main tree grows from"
        )
    if not vertex_count and value["root"] is not None:
        raise DocumentError("root names a vertex but there is none; write null")
    shape = (vertex_count, vertex_count)
    adjacency = coo_array((np.ones(len(edges), dtype=np.int8), edges.T), shape=shape)
    components = int(connected_components(adjacency, directed=False)[0]) if vertex_count else 0
    if len(edges) != vertex_count - components:
        raise DocumentError(
            f"edges: {len(edges)} edges on {vertex_count} vertices in {components} components make"
            " a cycle; take out an edge of each cycle"
        )
    if value["components"] != components:
        raise DocumentError(
            f"components is {value['components']} but the edges leave {components}; write that"
        )


def _check_branches(value: dict[str, Any]) -> None:
    """Check that branches partition the edges and that each leaves an earlier one outward."""
    missing = {(min(edge), max(edge)) for edge in value["edges"]}
    vertices_of: dict[int, set[int]] = {}
    entered: set[int] = set()
    for i, branch in enumerate(value["branches"]):
        path, parent = branch["vertices"], branch["parent"]
        if branch["id"] in vertices_of:
            raise DocumentError(f"branches[{i}].id {branch['id']} is taken; give each its own")
        if parent is not None and path[0] not in vertices_of.get(parent, ()):
            raise DocumentError(
                f"branches[{i}] starts at vertex {path[0]}, which is not on a branch {parent}"
                " listed before it; start it at its parent's vertex and list parents first"
            )
        for a, b in pairwise(path):
            edge = (min(a, b), max(a, b))
            if edge not in missing:
                raise DocumentError(
                    f"branches[{i}] uses {a}-{b}, which is no edge or on another branch already;"
                    " put every edge on exactly one branch"
                )
            missing.remove(edge)
            if b in entered:
                raise DocumentError(
                    f"branches[{i}] reaches vertex {b} a second time; list its vertices from the"
                    " root side outward"
                )
            entered.add(b)
        vertices_of[branch["id"]] = set(path)
    for i, branch in enumerate(value["branches"]):
        start = branch["vertices"][0]
        if branch["parent"] is None and start in entered:
            raise DocumentError(
                f"branches[{i}] has no parent but starts at vertex {start}, which a branch leads"
                " to; name the branch it grows from and list it after that"
            )
    if value["root"] in entered:
        raise DocumentError(
            f"root is vertex {value['root']}, which a branch leads to; name the vertex where the"
            " first branch of the main tree starts"
        )
    if missing:
        a, b = min(missing)
        raise DocumentError(f"edges: {a}-{b} is on no branch; put every edge on exactly one branch")
