"""The skeleton document `canopy-skeleton/1`: what planners read."""

from dataclasses import dataclass, field

from canopy_skel.geometry import BoolArray, FloatArray, IntArray


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


@dataclass(frozen=True, kw_only=True, eq=False, slots=True)
class Method:
    """How a document was made; `voxel_size_m` None where no map was used (ground truth)."""

    name: str
    voxel_size_m: float | None = None
    config_sha256: str | None = None
    software: str | None = None


@dataclass(frozen=True, kw_only=True, eq=False, slots=True)
class RejectedView:
    """A view that did not enter the skeleton, and why."""

    index: int
    reason: str


@dataclass(frozen=True, kw_only=True, eq=False, slots=True)
class SkeletonDocument:
    """A rooted forest in the base frame, metres.

    position: (V, 3); radius, confidence: (V,); occluded: (V,) bool; edges: (E, 2), acyclic,
    partitioned by `branches`. extra: further per-vertex arrays of the JSON by name, e.g.
    `segmented` in ground truth.
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
    root: int
    components: int
    extra: dict[str, tuple[object, ...]] = field(default_factory=dict)
