"""SWC: one line per vertex, parent before child; what neuron and plant tree tools read."""

from canopy_skel.document import SkeletonDocument

# Numbers from 10 on are free for one's own use in SWC.
_TYPE = {"trunk": 10, "branch": 11, "twig": 12}


def write_swc(document: SkeletonDocument) -> bytes:
    """Return the document as SWC, in metres; every component has its own root (parent -1)."""
    lines = [
        f"# skeleton of scan {' '.join(document.scan_id.split())}, revision {document.revision}",
        "# unit metre, frame base of the robot, z up",
        "# type 10 trunk, 11 branch, 12 twig, 0 a vertex on no branch",
        "# id type x y z radius parent",
    ]
    parent = document.parents()
    number: dict[int, int] = {-1: -1}
    kind = dict.fromkeys(range(len(parent)), 0)
    for branch in document.branches:
        kind |= dict.fromkeys(branch.vertices[1:], _TYPE[branch.kind])
        if parent[branch.vertices[0]] < 0:
            kind[branch.vertices[0]] = _TYPE[branch.kind]
    for v in _parents_first(document):
        number[v] = len(number)
        x, y, z = document.position[v]
        place = f"{x:.5f} {y:.5f} {z:.5f} {document.radius[v]:.5f}"
        lines.append(f"{number[v]} {kind[v]} {place} {number[int(parent[v])]}")
    return ("\n".join(lines) + "\n").encode()


def _parents_first(document: SkeletonDocument) -> list[int]:
    """Return all vertices, root first, each after its parent."""
    walk = [] if document.root is None else [document.root]
    walk += [v for branch in document.branches for v in branch.vertices]
    return list(dict.fromkeys([*walk, *range(len(document.position))]))
