"""Mode `canopy`: see more, join with calibrated confidence, reach behind the leaves.

Everything a view adds is kept per view, and what all views say together is built from sums of
integers and from arrays in the order of the views' numbers: no order of arrival can show.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from canopy_skel.confidence import Models
from canopy_skel.ends import find_ends
from canopy_skel.evidence import BACKGROUND, HIDDEN, LEAF, THROUGH, WOOD, count_evidence
from canopy_skel.extend import ExtensionConfig
from canopy_skel.frame import Float32Array, View
from canopy_skel.fusion import FusionConfig, Observations, Observed, fuse
from canopy_skel.geometry import BoolArray, FloatArray, IntArray
from canopy_skel.kernels import agree
from canopy_skel.likelihood import LikelihoodMap
from canopy_skel.links import LinkConfig, Parts
from canopy_skel.observe import Observation, moved, observe
from canopy_skel.pieces import PieceConfig
from canopy_skel.poses import (
    LoneView,
    PoseConfig,
    PoseCorrection,
    corrected,
    found_again,
    is_found,
    lone_views,
    one_after_other,
    pose_corrections,
)
from canopy_skel.segment import BranchMask
from canopy_skel.slivers import inside_thicker, on_axis
from canopy_skel.spline import BranchSpline
from canopy_skel.wood import FragmentConfig
from canopy_skel.woodpixels import PixelModel

POINT_FEATURES = 27
_ALONG_INSTANCES = 1
"""The column of what views agree on, see `kernels.agree`."""
NO_MAP_NATS = 12.0
"""-log p where the likelihood map says nothing."""


@dataclass(frozen=True, kw_only=True, slots=True)
class CanopyConfig:
    """Settings of the stages of mode `canopy`.

    use_fragments: wood outside the masks counts. min_point, min_fragment_point: points of
    instances, of fragments, less probable are dropped.
    min_piece_m: observed parts with less wood, not joined to others, are dropped. rooted: join
    what is left apart as well, with the low confidence it deserves, so that one tree results.
    """

    pieces: PieceConfig = field(default_factory=PieceConfig)
    fragments: FragmentConfig = field(default_factory=FragmentConfig)
    fusion: FusionConfig = field(default_factory=FusionConfig)
    poses: PoseConfig = field(default_factory=PoseConfig)
    links: LinkConfig = field(default_factory=LinkConfig)
    extensions: ExtensionConfig = field(default_factory=ExtensionConfig)
    use_fragments: bool = True
    min_point: float = 0.5
    min_fragment_point: float = 0.6
    min_piece_m: float = 0.015
    rooted: bool = False


_STAGES: Mapping[str, type[Any]] = {
    "pieces": PieceConfig,
    "fragments": FragmentConfig,
    "fusion": FusionConfig,
    "poses": PoseConfig,
    "links": LinkConfig,
    "extensions": ExtensionConfig,
}


def canopy_config_from(fields: Mapping[str, Any]) -> CanopyConfig:
    """Return the settings that `dataclasses.asdict` took apart.

    Raises:
        KeyError: a stage is missing.
        TypeError: a field is missing or unknown.
    """
    stages = {name: stage(**fields[name]) for name, stage in _STAGES.items()}
    return CanopyConfig(**{**fields, **stages})


class CanopyScan:
    """The views of one scan, in any order, and the skeleton of all so far.

    pixel_model: what tells wood beside the masks; None: the one that is shipped.
    """

    def __init__(self, config: CanopyConfig, pixel_model: PixelModel | None = None) -> None:
        self.config = config
        self._pixel_model = pixel_model
        self._seen: dict[int, Observation] = {}
        self._counts: dict[int, IntArray] = {}
        self._agreed: dict[int, IntArray] = {}

    def observe(
        self, view: View, masks: Sequence[BranchMask], maps: Float32Array | None = None
    ) -> Observation:
        """Return what a view shows; nothing changes.

        maps: (8, h, w) of the network; without, no wood is looked for beside the masks.
        """
        fragments = self.config.fragments if self.config.use_fragments else None
        return observe(view, list(masks), self.config.pieces, fragments, maps, self._pixel_model)

    def add(self, index: int, seen: Observation) -> None:
        """Take a view in: all points are asked in it, and its points in all views."""
        agreed = np.zeros((len(seen.points_in_base), agree.AGREEMENT), dtype=np.int64)
        for other, points in self._seen.items():
            seen.evidence.count(points.points_in_base, self._counts[other])
            self._agreed[other] += seen.agreement(points.points_in_base, points.directions)
            agreed += points.agreement(seen.points_in_base, seen.directions)
        self._seen[index] = seen
        self._agreed[index] = agreed
        self._counts[index] = count_evidence(
            seen.points_in_base, (one.evidence for one in self._seen.values())
        )

    def remove(self, index: int) -> None:
        """Take a view off again, with all it said of the points of others."""
        gone = self._seen.pop(index, None)
        if gone is None:
            return
        del self._counts[index], self._agreed[index]
        for other, points in self._seen.items():
            gone.evidence.count(points.points_in_base, self._counts[other], times=-1)
            self._agreed[other] -= gone.agreement(points.points_in_base, points.directions)

    def evidence(self, points_in_base: FloatArray) -> IntArray:
        """Return how many views say what (N, 6) of points (N, 3)."""
        return count_evidence(points_in_base, (one.evidence for one in self._seen.values()))

    def points(self) -> tuple[FloatArray, FloatArray, FloatArray, BoolArray, IntArray, FloatArray]:
        """Return all observed points: positions, directions, radii, fragment, view, features.

        In the order of the views' numbers.
        """
        order = sorted(self._seen)
        seen = [self._seen[i] for i in order]
        features = [point_features(self._seen[i], self._counts[i], self._agreed[i]) for i in order]
        view = [np.full(len(s.points_in_base), n, dtype=np.int64) for n, s in enumerate(seen)]
        return (
            np.concatenate([np.zeros((0, 3)), *(s.points_in_base for s in seen)]),
            np.concatenate([np.zeros((0, 3)), *(s.directions for s in seen)]),
            np.concatenate([np.zeros(0), *(s.radius_m for s in seen)]),
            np.concatenate([np.zeros(0, dtype=np.bool_), *(s.fragment for s in seen)]),
            np.concatenate([np.zeros(0, dtype=np.int64), *view]),
            np.concatenate([np.zeros((0, POINT_FEATURES)), *features]),
        )

    def believed(self, models: Models) -> Observations:
        """Return the observed points that are probably wood, strips of trunks on their axes."""
        points, directions, radius_m, fragment, view, features = self.points()
        probability = np.empty(len(points))
        probability[fragment] = models.fragment_point(features[fragment])
        probability[~fragment] = models.instance_point(features[~fragment])
        limit = np.where(fragment, self.config.min_fragment_point, self.config.min_point)
        seen = Observations(
            points_in_base=points,
            directions=directions,
            radius_m=radius_m,
            probable_radius_m=self._probable_radii(),
            probability=probability,
            view=view,
            fragment=fragment,
        ).chosen(probability >= limit)
        seen = on_axis(seen)
        return seen.chosen(~inside_thicker(seen))

    def _probable_radii(self) -> FloatArray:
        """Return how thick the wood at all points probably is (N,), in the order of `points`."""
        order = sorted(self._seen)
        return np.concatenate([np.zeros(0), *(self._seen[i].probable_radius_m for i in order)])

    def observed(self, models: Models) -> tuple[Observed, list[PoseCorrection]]:
        """Return the fused forest of what was seen, and which views were moved for it."""
        seen = self.believed(models)
        fused = fuse(seen, self.config.fusion)
        corrections = pose_corrections(seen, fused, self.config.poses)
        if corrections:
            seen = replace(seen, points_in_base=corrected(seen, corrections))
            fused = fuse(seen, self.config.fusion)
        return fused, corrections

    def brought_back(self, models: Models) -> tuple["CanopyScan", list[PoseCorrection]]:
        """Return the scan with its lone views where the other views show their wood.

        And how they were moved. The scan itself, if there are none that fit anywhere. What comes
        back shows more wood for others to fit to, so that they are asked again.
        """
        scan, corrections = self, list[PoseCorrection]()
        for _ in self._seen:
            scan, found = scan._once_brought_back(models)
            if not found:
                break
            corrections = one_after_other(corrections, found)
        return scan, corrections

    def _once_brought_back(self, models: Models) -> tuple["CanopyScan", list[PoseCorrection]]:
        alone = self.lone_views()
        if not alone:
            return self, []
        seen = self.believed(models)
        others = seen.chosen(~np.isin(seen.view, [one.view for one in alone]))
        fused = fuse(others, self.config.fusion)
        order, scan, corrections = sorted(self._seen), self, []
        for one in alone:
            index = order[one.view]
            view = self._seen[index]
            points, ways = (a[~view.fragment] for a in (view.points_in_base, view.directions))
            found = found_again(one.view, points, ways, fused, self.config.poses)
            if found is None:
                continue
            there = scan._with(index, moved(view, found.moved))
            if is_found(one, float(there.along_others()[0][one.view])):
                scan = there
                corrections.append(found)
        return scan, corrections

    def _with(self, index: int, seen: Observation) -> "CanopyScan":
        """Return a scan in which a view has seen something else."""
        scan = CanopyScan(self.config, self._pixel_model)
        scan._seen = dict(self._seen)
        for mine, its in ((self._counts, scan._counts), (self._agreed, scan._agreed)):
            its.update({other: values.copy() for other, values in mine.items()})
        scan.remove(index)
        scan.add(index, seen)
        return scan

    def splines(self) -> list[list[BranchSpline]]:
        """Return the instances of each view as polylines, in the order of the views' numbers."""
        return [self._seen[index].splines for index in sorted(self._seen)]

    def lone_views(self) -> list[LoneView]:
        """Return the views that hardly any other agrees with."""
        return lone_views(*self.along_others())

    def along_others(self) -> tuple[FloatArray, IntArray]:
        """Return how much of each view's wood others show any along (V,), and its points (V,)."""
        order = sorted(self._seen)
        of_masks = [~self._seen[index].fragment for index in order]
        points = np.array([np.count_nonzero(chosen) for chosen in of_masks], dtype=np.int64)
        along = [
            np.count_nonzero(self._agreed[index][chosen, _ALONG_INSTANCES])
            for index, chosen in zip(order, of_masks, strict=True)
        ]
        return np.array(along) / np.maximum(points, 1), points

    def parts(self, observed: Observed, models: Models) -> tuple[Parts, Observed]:
        """Return what is to be joined, without specks, and the forest in the same numbers."""
        component, length_m = component_lengths(observed)
        stay = length_m >= self.config.min_piece_m
        observed = chosen(observed, stay)
        component, length_m = component_lengths(observed)
        return (
            Parts(
                points=observed.vertices_in_base,
                directions=observed.directions,
                component=component,
                length_m=length_m,
                confidence=models.vertex(vertex_features(observed, length_m)),
                radius_m=observed.support[:, 1],
                probable_radius_m=observed.support[:, 6],
                fragment=observed.support[:, 5] < 0.5,
                ends=find_ends(observed.vertices_in_base, observed.directions, observed.edges),
            ),
            observed,
        )


def map_cost(likelihood: LikelihoodMap, points_in_base: FloatArray) -> FloatArray:
    """Return -log p_l (N,) of the likelihood map at points, capped where it says nothing."""
    voxels = np.floor(points_in_base / likelihood.voxel_size_m).astype(np.int32)
    probability = likelihood.probability_at(voxels)
    return np.asarray(-np.log(np.maximum(probability, np.exp(-NO_MAP_NATS))))


def point_features(seen: Observation, counts: IntArray, agreed: IntArray) -> FloatArray:
    """Return what speaks for each point being wood (N, POINT_FEATURES).

    What all views say counts at the point and as the mean along its piece: a false mask is false
    as a whole.
    """
    empty = counts[:, THROUGH] + counts[:, BACKGROUND]
    total = np.maximum(empty + counts[:, WOOD] + counts[:, LEAF], 1)
    said = np.column_stack(
        [
            np.minimum(empty, 3),
            counts[:, WOOD] / total,
            np.log1p(agreed),
            agreed[:, 1:].sum(axis=1) / np.maximum(agreed[:, 0], 1),
        ]
    )
    return np.column_stack(
        [
            seen.quality,
            np.log1p(counts[:, WOOD]),
            np.log1p(counts[:, LEAF]),
            np.log1p(counts[:, HIDDEN]),
            said,
            piece_means(said, seen.piece),
        ]
    )


def piece_means(values: FloatArray, piece: IntArray) -> FloatArray:
    """Return of values (N, F) their means (N, F) over the points of the same piece."""
    points = np.maximum(np.bincount(piece), 1)
    sums = [np.bincount(piece, weights=column, minlength=len(points)) for column in values.T]
    return np.column_stack([total / points for total in sums])[piece]


def vertex_features(observed: Observed, length_m: FloatArray) -> FloatArray:
    """Return what speaks for each fused vertex (V, 7)."""
    weight, radius_m, mean_p, largest_p, views, masks, _ = observed.support.T
    return np.column_stack(
        [
            np.log(np.maximum(views, 1)),
            largest_p,
            mean_p,
            np.log(weight + 0.1),
            np.log(np.maximum(radius_m, 1e-4)),
            np.log(length_m + 0.01),
            masks,
        ]
    )


def component_lengths(observed: Observed) -> tuple[IntArray, FloatArray]:
    """Return the component of each vertex (V,) and how much wood that component holds (V,)."""
    n, edges = len(observed.vertices_in_base), observed.edges
    adjacency = coo_array((np.ones(len(edges), np.int8), edges.T), shape=(n, n))
    _, component = connected_components(adjacency, directed=False)
    start, end = observed.vertices_in_base[edges.T]
    of_edge = np.linalg.norm(end - start, axis=1)
    total = np.bincount(
        component[edges[:, 0]], weights=of_edge, minlength=component.max(initial=-1) + 1
    )
    return component.astype(np.int64), np.asarray(total, dtype=np.float64)[component]


def chosen(observed: Observed, stay: BoolArray) -> Observed:
    """Return the forest without the vertices that do not stay; whole components go."""
    number = np.cumsum(stay) - 1
    kept = stay[observed.edges].all(axis=1)
    return Observed(
        vertices_in_base=observed.vertices_in_base[stay],
        directions=observed.directions[stay],
        support=observed.support[stay],
        edges=number[observed.edges[kept]],
    )
