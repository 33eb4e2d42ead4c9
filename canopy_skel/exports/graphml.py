"""GraphML: the skeleton as a directed graph, root outward, for networkx, Gephi, igraph.

Written here and not by networkx, whose writer takes seconds for 30,000 vertices and spells
booleans in Python's way; networkx reads it in the tests.
"""

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


def write_graphml(document: SkeletonDocument) -> bytes:
    """Return nodes with x, y, z, radius, confidence, occluded; edges with length and branch id.

    Lengths in metres, positions in the base frame, z up.
    """
    graph_values = (SCHEMA_NAME, document.scan_id, str(document.revision), "base")
    lines = [
        '<?xml version="1.0" encoding="UTF-8"?>',
        '<graphml xmlns="http://graphml.graphdrawing.org/xmlns">',
        *(
            f'<key id="{target}_{name}" for="{target}" attr.name="{name}" attr.type="{kind}"/>'
            for target, kinds in (("graph", _GRAPH), ("node", _NODE), ("edge", _EDGE))
            for name, kind in kinds.items()
        ),
        '<graph id="skeleton" edgedefault="directed">',
        _data("graph", _GRAPH, graph_values),
        *_nodes(document),
        *_edges(document),
        "</graph>",
        "</graphml>",
    ]
    return ("\n".join(lines) + "\n").encode()


def _nodes(document: SkeletonDocument) -> list[str]:
    rows = zip(
        *document.position.T.tolist(),
        document.radius.tolist(),
        document.confidence.tolist(),
        ["true" if occluded else "false" for occluded in document.occluded],
        strict=True,
    )
    return [
        f'<node id="{v}">{_data("node", _NODE, tuple(map(str, row)))}</node>'
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


def _data(target: str, kinds: dict[str, str], values: tuple[str, ...]) -> str:
    return "".join(
        f'<data key="{target}_{name}">{escape(value)}</data>'
        for name, value in zip(kinds, values, strict=True)
    )
