"""glTF 2.0 binary (`.glb`): tubes to look at and to plan with, the centre line, and the numbers.

Nodes are the branches, children under their parents; one node at the top turns the z-up base
frame to glTF's y-up, so every POSITION is in the robot's base frame, in metres.
"""

import json
import math
import struct

import numpy as np
from numpy.typing import NDArray

from canopy_skel.document import Branch, SkeletonDocument
from canopy_skel.exports.palette import OBSERVED_RGB, OCCLUDED_RGB
from canopy_skel.exports.tubes import SIDES, Tubes, build_tubes
from canopy_skel.geometry import BoolArray, FloatArray, IntArray
from canopy_skel.schema import SCHEMA_NAME

_FLOAT, _UNSIGNED_BYTE, _UNSIGNED_SHORT, _UNSIGNED_INT = 5126, 5121, 5123, 5125
_ARRAY_BUFFER, _ELEMENT_ARRAY_BUFFER = 34962, 34963
_LINES = 1
_WOOD, _CENTRE_LINE = 0, 1
_MATERIALS = [
    {"name": "wood", "pbrMetallicRoughness": {"metallicFactor": 0.0, "roughnessFactor": 0.9}},
    {
        "name": "centre line",
        "pbrMetallicRoughness": {"metallicFactor": 0.0},
        "extensions": {"KHR_materials_unlit": {}},
    },
]
# A quarter turn about x: base z becomes y.
_Y_UP = [-math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5)]

_Json = dict[str, object]


def write_glb(document: SkeletonDocument) -> bytes:
    """Return the document as a `.glb`; without branches it holds the top node alone."""
    buffer = _Buffer()
    nodes: list[_Json] = [{"name": "tree", "rotation": _Y_UP, "extras": _tree_extras(document)}]
    meshes: list[_Json] = []
    if document.branches:
        meshes.append({"name": "centre line", "primitives": [_centre_line(buffer, document)]})
        nodes.append({"name": "centre line", "mesh": 0})
        tubes = build_tubes(document)
        meshes += _branch_meshes(buffer, document, tubes)
        children = _children(document)
        nodes += _branch_nodes(document, children)
        nodes[0]["children"] = [1, *children[None]]
    gltf: _Json = {
        "asset": {"version": "2.0", "generator": "canopy-skel"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": nodes,
    }
    if meshes:
        gltf |= {"meshes": meshes, "materials": _MATERIALS}
        gltf |= {"extensionsUsed": ["KHR_materials_unlit"], **buffer.fields()}
    return _container(gltf, bytes(buffer.data))


class _Buffer:
    """The one binary buffer of the file, with the views and accessors into it."""

    def __init__(self) -> None:
        self.data = bytearray()
        self._views: list[_Json] = []
        self._accessors: list[_Json] = []

    def add_view(self, array: NDArray[np.generic], *, target: int) -> int:
        """Append an array and return its view; rows of vertex attributes must fill 4 bytes."""
        self.data += bytes(-len(self.data) % 4)
        raw = np.ascontiguousarray(array).tobytes()
        view: _Json = {
            "buffer": 0,
            "byteOffset": len(self.data),
            "byteLength": len(raw),
            "target": target,
        }
        if target == _ARRAY_BUFFER:
            view["byteStride"] = len(raw) // len(array)
        self.data += raw
        self._views.append(view)
        return len(self._views) - 1

    def add_accessor(self, view: int, array: NDArray[np.generic], skip: int, **more: object) -> int:
        """Return an accessor to `array`, the rows of the view after `skip` ones."""
        component = {
            np.dtype(np.float32): _FLOAT,
            np.dtype(np.uint8): _UNSIGNED_BYTE,
            np.dtype(np.uint16): _UNSIGNED_SHORT,
            np.dtype(np.uint32): _UNSIGNED_INT,
        }[array.dtype]
        row_bytes = array.nbytes // len(array)
        self._accessors.append(
            {
                "bufferView": view,
                "byteOffset": skip * row_bytes,
                "componentType": component,
                "count": len(array),
                "type": "SCALAR" if array.ndim == 1 else f"VEC{array.shape[1]}",
                **more,
            }
        )
        return len(self._accessors) - 1

    def fields(self) -> _Json:
        """Return the top-level entries that describe the buffer."""
        return {
            "accessors": self._accessors,
            "bufferViews": self._views,
            "buffers": [{"byteLength": len(self.data)}],
        }


class _Attributes:
    """Vertex attributes of many primitives, one view each; primitives are runs of rows."""

    def __init__(self, buffer: _Buffer, arrays: dict[str, NDArray[np.generic]]) -> None:
        self._buffer = buffer
        self._arrays = arrays
        self._views = {
            name: buffer.add_view(array, target=_ARRAY_BUFFER) for name, array in arrays.items()
        }

    def run(self, start: int, stop: int) -> dict[str, int]:
        """Return the accessors of the rows from `start` to before `stop`."""
        accessors = {}
        for name, array in self._arrays.items():
            rows = array[start:stop]
            more: _Json = {}
            if name == "POSITION":
                more = {"min": rows.min(axis=0).tolist(), "max": rows.max(axis=0).tolist()}
            elif name == "COLOR_0":
                more = {"normalized": True}
            accessors[name] = self._buffer.add_accessor(self._views[name], rows, start, **more)
        return accessors


def _attribute_arrays(
    document: SkeletonDocument, vertex: IntArray, position: FloatArray, radius_m: FloatArray
) -> dict[str, NDArray[np.generic]]:
    return {
        "POSITION": position.astype(np.float32),
        "COLOR_0": _colors(document.occluded[vertex]),
        "_RADIUS": radius_m.astype(np.float32),
        "_CONFIDENCE": document.confidence[vertex].astype(np.float32),
        "_OCCLUDED": document.occluded[vertex].astype(np.float32),
    }


def _colors(occluded: BoolArray) -> NDArray[np.uint8]:
    """Return (N, 4) RGBA; glTF's vertex colours are linear light."""
    srgb = np.array([OBSERVED_RGB, OCCLUDED_RGB]) / 255.0
    linear = np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)
    rgba = np.column_stack([np.round(linear * 255), [255, 255]]).astype(np.uint8)
    return rgba[occluded.astype(np.int64)]


def _index_array(indices: IntArray) -> NDArray[np.generic]:
    # 65535 itself restarts primitives.
    return indices.astype(np.uint16 if indices.max() < 65535 else np.uint32)


def _centre_line(buffer: _Buffer, document: SkeletonDocument) -> _Json:
    everything = np.arange(len(document.position))
    arrays = _attribute_arrays(document, everything, document.position, document.radius)
    indices = _index_array(document.edges.ravel())
    view = buffer.add_view(indices, target=_ELEMENT_ARRAY_BUFFER)
    return {
        "attributes": _Attributes(buffer, arrays).run(0, len(everything)),
        "indices": buffer.add_accessor(view, indices, 0),
        "mode": _LINES,
        "material": _CENTRE_LINE,
    }


def _branch_meshes(buffer: _Buffer, document: SkeletonDocument, tubes: Tubes) -> list[_Json]:
    arrays = _attribute_arrays(
        document,
        np.repeat(tubes.vertex, SIDES),
        tubes.position.reshape(-1, 3),
        np.repeat(tubes.radius_m, SIDES),
    )
    arrays["NORMAL"] = tubes.normal.reshape(-1, 3).astype(np.float32)
    attributes = _Attributes(buffer, arrays)
    triangles = [tubes.triangles(branch).ravel() for branch in range(len(document.branches))]
    indices = _index_array(np.concatenate(triangles))
    view = buffer.add_view(indices, target=_ELEMENT_ARRAY_BUFFER)
    meshes: list[_Json] = []
    skip = 0
    for branch, own in enumerate(triangles):
        start, stop = (SIDES * tubes.first_ring[branch : branch + 2]).tolist()
        primitive = {
            "attributes": attributes.run(start, stop),
            "indices": buffer.add_accessor(view, indices[skip : skip + len(own)], skip),
            "material": _WOOD,
        }
        skip += len(own)
        meshes.append({"name": _branch_name(document.branches[branch]), "primitives": [primitive]})
    return meshes


def _branch_nodes(document: SkeletonDocument, children: dict[int | None, list[int]]) -> list[_Json]:
    """Return a node per branch; the i-th branch is node i + 2 and mesh i + 1."""
    nodes: list[_Json] = []
    for i, branch in enumerate(document.branches):
        extras = {name: getattr(branch, name) for name in Branch.__slots__ if name != "vertices"}
        node: _Json = {"name": _branch_name(branch), "mesh": i + 1, "extras": extras}
        if branch.id in children:
            node["children"] = children[branch.id]
        nodes.append(node)
    return nodes


def _children(document: SkeletonDocument) -> dict[int | None, list[int]]:
    """Return the nodes of the branches that hang on each branch, by its id."""
    nodes: dict[int | None, list[int]] = {}
    for i, branch in enumerate(document.branches):
        nodes.setdefault(branch.parent, []).append(i + 2)
    return nodes


def _branch_name(branch: Branch) -> str:
    return f"{branch.kind} {branch.id}"


def _tree_extras(document: SkeletonDocument) -> _Json:
    return {
        "schema": SCHEMA_NAME,
        "scan_id": document.scan_id,
        "revision": document.revision,
        "frame": "base",
        "unit": "m",
        "method": document.method.fields(),
        "components": document.components,
    }


def _container(gltf: _Json, binary: bytes) -> bytes:
    """Pack the JSON and, if there is any, the binary chunk as GLB version 2."""
    text = json.dumps(gltf, separators=(",", ":"), ensure_ascii=False, allow_nan=False).encode()
    chunks = [(b"JSON", text + b" " * (-len(text) % 4))]
    if binary:
        chunks.append((b"BIN\0", binary + bytes(-len(binary) % 4)))
    body = b"".join(struct.pack("<I4s", len(data), kind) + data for kind, data in chunks)
    return struct.pack("<4sII", b"glTF", 2, 12 + len(body)) + body
