"""Triangles with labels, and the tubes and balls that are made of them."""

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from canopy_skel.frame import Float32Array
from canopy_skel.geometry import FloatArray, IntArray
from mock_hw.orchard.tree import Tree, TreeBranch

Int32Array = NDArray[np.int32]
UInt8Array = NDArray[np.uint8]
_GOLDEN = 0.6180339887


class Kind(IntEnum):
    """What a pixel shows. Only WOOD is labelled; FAR_* belong to the neighbour rows."""

    SKY = 0
    GROUND = 1
    WOOD = 2
    LEAF = 3
    FRUIT = 4
    POST = 5
    WIRE = 6
    FAR_WOOD = 7
    FAR_LEAF = 8


@dataclass(frozen=True, kw_only=True, eq=False, slots=True)
class Mesh:
    """Triangles in the base frame.

    points: (P, 3) metres. normals: (P, 3). texture: (P, 3) coordinates that the wind does not
    move; on leaves: along, across, petiole flag. anchor: (P,) skeleton vertex the point moves
    with, -1 = none. triangles: (T, 3). kind: (T,). vertex: (T,) skeleton vertex the face shows,
    -1 = no wood of the tree. tone: (T,) a random number in [0, 1] per object.
    """

    points: FloatArray
    normals: Float32Array
    texture: Float32Array
    anchor: Int32Array
    triangles: Int32Array
    kind: UInt8Array
    vertex: Int32Array
    tone: Float32Array


def merged(meshes: list[Mesh]) -> Mesh:
    """Put meshes into one, in order."""
    offsets = np.cumsum([0] + [len(mesh.points) for mesh in meshes[:-1]])
    triangles = [mesh.triangles + k for mesh, k in zip(meshes, offsets, strict=True)]
    return Mesh(
        points=np.concatenate([mesh.points for mesh in meshes]),
        normals=np.concatenate([mesh.normals for mesh in meshes]),
        texture=np.concatenate([mesh.texture for mesh in meshes]),
        anchor=np.concatenate([mesh.anchor for mesh in meshes]),
        triangles=np.concatenate(triangles).astype(np.int32),
        kind=np.concatenate([mesh.kind for mesh in meshes]),
        vertex=np.concatenate([mesh.vertex for mesh in meshes]),
        tone=np.concatenate([mesh.tone for mesh in meshes]),
    )


def mesh_of_wood(tree: Tree) -> Mesh:
    """Return tapered tubes; the face band around a skeleton vertex carries its index.

    Rings lie half-way between vertices; a tube's width is that of a circle of the true radius.
    """
    return merged([_branch_tube(tree, branch) for branch in tree.branches])


def _branch_tube(tree: Tree, branch: TreeBranch) -> Mesh:
    vertices = branch.vertices
    position, radius = tree.position[vertices], tree.radius_m[vertices].copy()
    if branch.parent is not None:
        radius[0] = radius[1]
    middle = 0.5 * (position[1:] + position[:-1])
    line = np.concatenate([position[:1], middle, position[-1:]])
    width = np.concatenate([radius[:1], 0.5 * (radius[1:] + radius[:-1]), radius[-1:]])
    tone = (branch.id * _GOLDEN) % 1.0
    return tube(line, width, vertices.astype(np.int32), Kind.WOOD, tone=tone)


def tube(
    line: FloatArray, radius_m: FloatArray, label: Int32Array, kind: Kind, *, tone: float
) -> Mesh:
    """Return a closed tube along `line` (N, 3); its N-1 bands carry `label` (N-1,), -1 = none."""
    sides = int(np.clip(6 + 400 * radius_m.max(), 7, 18))
    n = len(line)
    axis, across, other = _frames(line)
    turn = 2 * np.pi * np.arange(sides) / sides
    spokes = np.cos(turn)[:, None] * across[:, None] + np.sin(turn)[:, None] * other[:, None]
    fair = np.sqrt((2 * np.pi / sides) / np.sin(2 * np.pi / sides))
    rings = line[:, None] + fair * radius_m[:, None, None] * spokes
    tip = line[-1] + 0.7 * radius_m[-1] * axis[-1]
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))])
    texture = np.empty((n, sides, 3), dtype=np.float32)
    texture[..., 0] = radius_m[:, None] * np.cos(turn)
    texture[..., 1] = radius_m[:, None] * np.sin(turn)
    texture[..., 2] = along[:, None]
    bands = _bands(n, sides)
    faces = np.repeat(label, 2 * sides)
    return Mesh(
        points=np.concatenate([rings.reshape(-1, 3), tip[None]]),
        normals=np.concatenate([spokes.reshape(-1, 3), axis[-1:]]).astype(np.float32),
        texture=np.concatenate([texture.reshape(-1, 3), texture[-1, :1]]),
        anchor=np.append(np.repeat(np.append(label, label[-1]), sides), label[-1]).astype(np.int32),
        triangles=bands,
        kind=np.full(len(bands), kind, dtype=np.uint8),
        vertex=np.concatenate([faces, np.full(sides, label[-1])]).astype(np.int32),
        tone=np.full(len(bands), tone, dtype=np.float32),
    )


def _bands(rings: int, sides: int) -> Int32Array:
    """Return the faces of a tube, band by band, then of its tip."""
    k, i = np.meshgrid(np.arange(rings - 1), np.arange(sides), indexing="ij")
    a, b = k * sides + i, k * sides + (i + 1) % sides
    quads = np.stack([a, b, b + sides, a, b + sides, a + sides], axis=-1).reshape(-1, 3)
    last = (rings - 1) * sides
    rim = np.arange(sides)
    cap = np.stack([last + rim, last + (rim + 1) % sides, np.full(sides, rings * sides)], axis=-1)
    return np.concatenate([quads, cap]).astype(np.int32)


def _frames(line: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return tangents and two normals that do not twist (parallel transport), each (N, 3)."""
    tangent = np.gradient(line, axis=0)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    across = np.empty_like(tangent)
    start = np.eye(3)[np.argmin(np.abs(tangent[0]))]
    for k, direction in enumerate(tangent):
        start = start - (start @ direction) * direction
        start = start / np.linalg.norm(start)
        across[k] = start
    return tangent, across, np.cross(tangent, across)


def balls(
    centres: FloatArray,
    radius_m: FloatArray,
    flatness: float,
    anchor: IntArray,
    tone: FloatArray,
) -> Mesh:
    """Return fruit: globes with dimples at stalk and calyx; (N, 3) centres, (N,) radii."""
    rows, columns = 9, 14
    polar, turn = np.meshgrid(
        np.linspace(0, np.pi, rows), 2 * np.pi * np.arange(columns) / columns, indexing="ij"
    )
    shape = np.stack(
        [
            np.sin(polar) * np.cos(turn),
            np.sin(polar) * np.sin(turn),
            flatness * np.cos(polar) * (1 - 0.3 * np.exp(-((np.sin(polar) / 0.3) ** 2))),
        ],
        axis=-1,
    ).reshape(-1, 3)
    k, i = np.meshgrid(np.arange(rows - 1), np.arange(columns), indexing="ij")
    a, b = k * columns + i, k * columns + (i + 1) % columns
    faces = np.stack([a, b, b + columns, a, b + columns, a + columns], axis=-1).reshape(-1, 3)
    n, per = len(centres), len(shape)
    points = centres[:, None] + radius_m[:, None, None] * shape
    triangles = (np.arange(n)[:, None, None] * per + faces).reshape(-1, 3)
    return Mesh(
        points=points.reshape(-1, 3),
        normals=np.tile(shape, (n, 1)).astype(np.float32),
        texture=np.tile(shape, (n, 1)).astype(np.float32),
        anchor=np.repeat(anchor, per).astype(np.int32),
        triangles=triangles.astype(np.int32),
        kind=np.full(len(triangles), Kind.FRUIT, dtype=np.uint8),
        vertex=np.full(len(triangles), -1, dtype=np.int32),
        tone=np.repeat(tone, len(faces)).astype(np.float32),
    )


def straight_tube(
    start: FloatArray, end: FloatArray, radius_m: float, kind: Kind, *, piece_m: float
) -> Mesh:
    """Return an unlabelled post or wire between two points, in pieces no longer than `piece_m`."""
    pieces = max(int(np.ceil(np.linalg.norm(end - start) / piece_m)), 1)
    line = start + np.linspace(0, 1, pieces + 1)[:, None] * (end - start)
    label = np.full(pieces, -1, dtype=np.int32)
    return tube(line, np.full(pieces + 1, radius_m), label, kind, tone=0.5)
