"""PLY: coloured points with radius, confidence and flag, and the edges; for cloud tools."""

import numpy as np

from canopy_skel.document import SkeletonDocument
from canopy_skel.exports.palette import OBSERVED_RGB, OCCLUDED_RGB

_VERTEX = (
    ("x", "<f4"),
    ("y", "<f4"),
    ("z", "<f4"),
    ("red", "u1"),
    ("green", "u1"),
    ("blue", "u1"),
    ("radius", "<f4"),
    ("confidence", "<f4"),
    ("occluded", "u1"),
)
_EDGE = (("vertex1", "<i4"), ("vertex2", "<i4"))
_PLY_NAME = {"<f4": "float", "u1": "uchar", "<i4": "int"}


def write_ply(document: SkeletonDocument) -> bytes:
    """Return the document as binary little-endian PLY with elements `vertex` and `edge`."""
    vertices = np.empty(len(document.position), dtype=list(_VERTEX))
    colors = np.array([OBSERVED_RGB, OCCLUDED_RGB])[document.occluded.astype(np.int64)]
    for i, name in enumerate(("x", "y", "z")):
        vertices[name] = document.position[:, i]
    for i, name in enumerate(("red", "green", "blue")):
        vertices[name] = colors[:, i]
    for name in ("radius", "confidence", "occluded"):
        vertices[name] = getattr(document, name)
    edges = np.empty(len(document.edges), dtype=list(_EDGE))
    edges["vertex1"], edges["vertex2"] = document.edges.T
    header = [
        "ply",
        "format binary_little_endian 1.0",
        f"comment skeleton of scan {' '.join(document.scan_id.split())}, metres, z up",
        f"element vertex {len(vertices)}",
        *(f"property {_PLY_NAME[kind]} {name}" for name, kind in _VERTEX),
        f"element edge {len(edges)}",
        *(f"property {_PLY_NAME[kind]} {name}" for name, kind in _EDGE),
        "end_header",
    ]
    return (
        ("\n".join(header) + "\n").encode("ascii", "replace") + vertices.tobytes() + edges.tobytes()
    )
