"""GraphML: the skeleton as a directed graph, root outward, for networkx, Gephi, igraph.

Written here and not by networkx, whose writer takes seconds for 30,000 vertices and spells
booleans in Python's way; networkx reads it in the tests.
"""

import re
from itertools import pairwise
from xml.sax.saxutils import escape

import numpy as np

from canopy_skel.document import SkeletonDocument
from canopy_skel.schema import SCHEMA_NAME

_GRAPH = {"schema": "string", "scan_id": "string", "revision": "int", "frame": "string"}
_NODE = {
    **dict.fromkeys(("x", "y", "z", "radius", "confidence"), "double"),
    "occluded": "boolean",
}
_EDGE = {"length": "double", "branch": "int"}
_KINDS = {
    frozenset({bool}): "boolean",
    frozenset({int}): "long",
    frozenset({float}): "double",
    frozenset({int, float}): "double",
    frozenset({str}): "string",
}
_NO_XML = re.compile("[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")
"""Characters that XML 1.0 cannot hold, not even escaped."""


def write_graphml(document: SkeletonDocument) -> bytes:
    """Return nodes with x, y, z and all vertex values; edges with length and branch id.

    Lengths in metres, positions in the base frame, z up. Further arrays are left out where a vertex
    has more than one value, or not all values are of one kind.
    """
    extra = _extra(document)
    node = _NODE | {name: kind for name, (kind, _) in extra.items()}
    graph_values = (SCHEMA_NAME, document.scan_id, str(document.revision), "base")
    lines = [
        '<?xml version="1.0" encoding="UTF-8"?>',
        '<graphml xmlns="http://graphml.graphdrawing.org/xmlns">',
        *(
            f'<key id="{target}_{name}" for="{target}" attr.name="{name}" attr.type="{kind}"/>'
            for target, kinds in (("graph", _GRAPH), ("node", node), ("edge", _EDGE))
            for name, kind in kinds.items()
        ),
        '<graph id="skeleton" edgedefault="directed">',
        _data("graph", _GRAPH, graph_values),
        *_nodes(document, node, [column for _, column in extra.values()]),
        *_edges(document),
        "</graph>",
        "</graphml>",
    ]
    return _NO_XML.sub("\ufffd", "\n".join(lines) + "\n").encode()


def _extra(document: SkeletonDocument) -> dict[str, tuple[str, tuple[object, ...]]]:
    """Return kinds and values of further arrays by their names, as XML has them."""
    extra = {}
    for name, column in sorted(document.extra.items()):
        kind = _KINDS.get(frozenset(map(type, column)))
        if kind is not None and name not in _NODE:
            extra[escape(name, {'"': "&quot;"})] = (kind, column)
    return extra


def _nodes(
    document: SkeletonDocument, node: dict[str, str], extra: list[tuple[object, ...]]
) -> list[str]:
    rows = zip(
        *document.position.T.tolist(),
        document.radius.tolist(),
        document.confidence.tolist(),
        document.occluded.tolist(),
        *extra,
        strict=True,
    )
    return [
        f'<node id="{v}">{_data("node", node, tuple(map(_text, row)))}</node>'
        for v, row in enumerate(rows)
    ]


def _edges(document: SkeletonDocument) -> list[str]:
    lines = []
    for branch in document.branches:
        points = document.position[list(branch.vertices)]
        lengths_m = np.linalg.norm(np.diff(points, axis=0), axis=1).tolist()
        for (a, b), length_m in zip(pairwise(branch.vertices), lengths_m, strict=True):
            data = _data("edge", _EDGE, (f"{length_m:.5f}", str(branch.id)))
            lines.append(f'<edge source="{a}" target="{b}">{data}</edge>')
    return lines


def _text(value: object) -> str:
    return str(value).lower() if isinstance(value, bool) else str(value)


def _data(target: str, kinds: dict[str, str], values: tuple[str, ...]) -> str:
    return "".join(
        f'<data key="{target}_{name}">{escape(value)}</data>'
        for name, value in zip(kinds, values, strict=True)
    )
