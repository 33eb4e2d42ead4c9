"""A synthetic canopy for benchmarks: chains of wood with gaps between, seen piece by piece.

66 m of wood in a box of 2 m, as an orchard tree has. Not a picture of a tree: no leaves, no false
detections, perfect poses; what stages cost depends on lengths, radii, noise and overlap alone.
"""

from dataclasses import dataclass

import numpy as np

from canopy_skel.cluster import BranchCluster
from canopy_skel.frame import Intrinsics, View
from canopy_skel.segment import BranchMask

BOX_M = 2.0
WIDTH_PX, HEIGHT_PX = 1280, 800
SECTION_M = 0.17
OVERLAP_M = 0.02
NOISE_M = 0.002


@dataclass(frozen=True, kw_only=True)
class Section:
    """A piece of wood that one mask shows: the ends (3,), the radius."""

    start: np.ndarray
    end: np.ndarray
    radius_m: float


def sections_of_canopy(fragments, *, wood_m=66.0, box_m=BOX_M, seed=0):
    """Return sections of `fragments` chains that together are `wood_m` long."""
    random = np.random.default_rng(seed)
    sections = []
    for _ in range(fragments):
        at = random.uniform(0.1, box_m - 0.1, 3)
        heading = random.normal(size=3)
        radius_m = 0.0032 * np.exp(random.normal(0, 0.4))
        left_m = wood_m / fragments
        while left_m > 1e-6:
            heading += random.normal(0, 0.15, 3)
            heading /= np.linalg.norm(heading)
            length_m = min(SECTION_M, left_m)
            end = at + length_m * heading
            # Off the walls of the box.
            heading = np.where((end < 0) | (end > box_m), -heading, heading)
            end = at + length_m * heading
            sections.append(Section(start=at, end=end, radius_m=radius_m))
            at, left_m = end, left_m - length_m
    return sections


def views_of(sections, *, views, instances, box_m=BOX_M, seed=1):
    """Return the clusters of each view: sections around a point that wanders through the box."""
    random = np.random.default_rng(seed)
    middles = np.array([(s.start + s.end) / 2 for s in sections])
    found = []
    for view in range(views):
        eye = np.array([box_m / 2, -1.0, box_m / 2])
        window = random.uniform(0, box_m, 3)
        near = np.argsort(np.linalg.norm(middles - window, axis=1))[: 3 * instances]
        chosen = random.permutation(near)[:instances]
        found.append(
            [cluster_of(sections[s], view, n, eye, random) for n, s in enumerate(chosen, start=1)]
        )
    return found


def cluster_of(section, view, instance, eye, random):
    """Return points on the side of a section that faces the eye."""
    axis = (section.end - section.start) / np.linalg.norm(section.end - section.start)
    count = int(np.clip(random.normal(1000, 300), 100, 3000))
    length_m = np.linalg.norm(section.end - section.start)
    along = random.uniform(-OVERLAP_M, length_m + OVERLAP_M, count)
    ray = (section.start + section.end) / 2 - eye
    ray -= (ray @ axis) * axis
    ray /= np.linalg.norm(ray)
    across = random.uniform(-1, 1, count)
    depth = -np.sqrt(1 - across**2)
    points = section.start + along[:, None] * axis
    points = points + section.radius_m * (
        across[:, None] * np.cross(ray, axis) + depth[:, None] * ray
    )
    points += random.normal(0, NOISE_M, points.shape)
    return BranchCluster(
        view_index=view,
        instance=instance,
        confidence=float(random.uniform(0.5, 0.99)),
        half_width_m=section.radius_m,
        camera_in_base=eye,
        points_in_base=points,
    )


def picture_of(instances, *, seed=2):
    """Return a view, and in it masks of straight pieces of wood of about 1000 pixels each."""
    random = np.random.default_rng(seed)
    rows, columns = np.mgrid[:HEIGHT_PX, :WIDTH_PX]
    depth_m = np.full((HEIGHT_PX, WIDTH_PX), 3.0)
    masks = []
    for number in range(1, instances + 1):
        middle = random.uniform((150, 150), (HEIGHT_PX - 150, WIDTH_PX - 150))
        angle = random.uniform(0, np.pi)
        along = (columns - middle[1]) * np.cos(angle) + (rows - middle[0]) * np.sin(angle)
        across = (rows - middle[0]) * np.cos(angle) - (columns - middle[1]) * np.sin(angle)
        inside = (np.abs(across) < random.uniform(2, 5)) & (np.abs(along) < 70)
        slope = random.uniform(-1e-3, 1e-3)
        depth_m[inside] = random.uniform(0.7, 1.4) + slope * along[inside]
        v, u = np.nonzero(inside)
        box = inside[v.min() : v.max() + 1, u.min() : u.max() + 1]
        masks.append(
            BranchMask(
                instance=number,
                left_px=int(u.min()),
                top_px=int(v.min()),
                mask=box,
                confidence=float(random.uniform(0.5, 0.99)),
            )
        )
    depth_m += random.normal(0, NOISE_M, depth_m.shape)
    view = View(
        index=0,
        stamp_ns=0,
        color_rgb=np.zeros((HEIGHT_PX, WIDTH_PX, 3), dtype=np.uint8),
        intrinsics=Intrinsics(
            fx_px=800, fy_px=800, cx_px=640, cy_px=400, width_px=WIDTH_PX, height_px=HEIGHT_PX
        ),
        base_from_camera=np.eye(4),
        depth_m=depth_m.astype(np.float32),
    )
    return view, masks
