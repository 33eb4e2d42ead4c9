"""Routes for planners: what is near a point, and the branches without their vertices."""

from dataclasses import asdict, dataclass
from typing import Annotated, Any

import numpy as np
from fastapi import APIRouter, Query

from canopy_skel.document import SkeletonDocument, from_json
from canopy_skel.geometry import FloatArray
from service.http.context import Context, Here, KnownScan
from service.http.problems import Problem
from service.http.skeletons import no_skeleton_yet

router = APIRouter(prefix="/v1/scans/{scan_id}/skeleton", tags=["skeletons"])
_FARTHEST_POINT_M = 1e6
Metres = Annotated[
    float,
    Query(
        ge=-_FARTHEST_POINT_M,
        le=_FARTHEST_POINT_M,
        allow_inf_nan=False,
        description="metres, in base",
    ),
]


@dataclass(frozen=True, kw_only=True, slots=True)
class Nearest:
    """A point on the centre line. vertices: the ends of its edge; the first is the nearer one."""

    revision: int
    position: tuple[float, float, float]
    distance_m: float
    radius_m: float
    occluded: bool
    confidence: float
    branch: int
    vertices: tuple[int, int]


@router.get("/nearest")
def nearest(
    scan_id: KnownScan,
    x: Metres,
    y: Metres,
    z: Metres,
    here: Here,
    min_confidence: Annotated[
        float, Query(ge=0.0, le=1.0, description="of wood that counts")
    ] = 0.0,
) -> dict[str, Any]:
    """Return the point of the newest skeleton's centre lines that is nearest to (x, y, z)."""
    document = _newest(here, scan_id)
    if not len(document.edges):
        raise no_skeleton_yet(here, scan_id)
    found = nearest_point(document, np.array([x, y, z]), min_confidence)
    if found is None:
        detail = (
            f"revision {document.revision} has no wood of confidence {min_confidence:g} or more"
        )
        raise Problem(404, "no_such_wood", "No wood as sure as that", detail)
    return asdict(found)


@router.get("/branches")
def branches(scan_id: KnownScan, here: Here) -> dict[str, Any]:
    """Return the branches of the newest skeleton, with where each begins and ends."""
    document = _newest(here, scan_id)
    return {
        "revision": document.revision,
        "branches": [
            {
                "id": branch.id,
                "parent": branch.parent,
                "order": branch.order,
                "kind": branch.kind,
                "length": branch.length,
                "mean_radius": branch.mean_radius,
                "confidence": branch.confidence,
                "start": document.position[branch.vertices[0]].tolist(),
                "end": document.position[branch.vertices[-1]].tolist(),
            }
            for branch in document.branches
        ],
    }


def nearest_point(
    document: SkeletonDocument, point_in_base: FloatArray, min_confidence: float = 0.0
) -> Nearest | None:
    """Return the point of the centre lines that is nearest to a point (3,).

    Only edges count whose ends both have the confidence; None if there is none.
    """
    sure = document.confidence[document.edges].min(axis=1, initial=1.0) >= min_confidence
    edges = document.edges[sure]
    if not len(edges):
        return None
    starts, ends = (document.position[edges[:, side]] for side in (0, 1))
    along = ends - starts
    length2 = np.maximum(np.sum(along**2, axis=1), np.finfo(np.float64).tiny)
    share = np.clip(np.sum((point_in_base - starts) * along, axis=1) / length2, 0.0, 1.0)
    feet = starts + share[:, None] * along
    distance_m = np.linalg.norm(point_in_base - feet, axis=1)
    edge = int(np.argmin(distance_m))
    a, b = (int(vertex) for vertex in edges[edge])
    near, far = (a, b) if share[edge] <= 0.5 else (b, a)
    x, y, z = feet[edge].tolist()
    return Nearest(
        revision=document.revision,
        position=(x, y, z),
        distance_m=float(distance_m[edge]),
        radius_m=float(np.interp(share[edge], [0, 1], document.radius[[a, b]])),
        occluded=bool(document.occluded[a] or document.occluded[b]),
        confidence=float(document.confidence[[a, b]].min()),
        branch=_branch_of(document, a, b),
        vertices=(near, far),
    )


def _branch_of(document: SkeletonDocument, a: int, b: int) -> int:
    for branch in document.branches:
        steps = zip(branch.vertices[:-1], branch.vertices[1:], strict=True)
        if any(step in ((a, b), (b, a)) for step in steps):
            return branch.id
    raise AssertionError("branches partition the edges")


def _newest(here: Context, scan_id: str) -> SkeletonDocument:
    newest = here.scans.catalogue.newest_revision(scan_id)
    if newest is None:
        raise no_skeleton_yet(here, scan_id)
    return from_json(newest.path.read_bytes(), str(newest.path))
