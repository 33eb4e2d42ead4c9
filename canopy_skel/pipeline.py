"""Views in, one growing likelihood map, a skeleton out: the whole method in the paper's order."""

import json
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager, nullcontext
from dataclasses import asdict, dataclass, field
from hashlib import sha256
from typing import Literal, get_args

import numpy as np

from canopy_skel.assemble import skeleton_of
from canopy_skel.baselines.ftsem import FtsemConfig, join_break_points
from canopy_skel.baselines.mst import join_by_spanning_tree
from canopy_skel.canopy import CanopyConfig, CanopyScan
from canopy_skel.cluster import ClusterConfig, RejectedInstance, cluster_branches
from canopy_skel.confidence import Depth, Models, shipped_models
from canopy_skel.errors import UsageError, ViewError
from canopy_skel.frame import View
from canopy_skel.geometry import FloatArray
from canopy_skel.graph import SkeletonGraph
from canopy_skel.initial import InitialConfig, initial_skeleton
from canopy_skel.likelihood import LikelihoodConfig, LikelihoodMap, segments_of
from canopy_skel.pathsearch import Join, PathSearch, add_paths, straighten_predicted
from canopy_skel.poses import LoneView, PoseCorrection, one_after_other
from canopy_skel.segment import Segmenter, require_masks
from canopy_skel.segmenters.mapping import WithMaps
from canopy_skel.segmenters.recorded import RecordedSegmenter
from canopy_skel.spline import BranchSpline, SplineConfig, fit_splines
from canopy_skel.strands import StrandMap

MethodName = Literal["canopy", "paper", "mst", "ftsem"]
METHODS: tuple[MethodName, ...] = get_args(MethodName)
DEFAULT_METHOD: MethodName = "canopy"
JOINERS: frozenset[MethodName] = frozenset({"paper", "mst", "ftsem"})
"""Methods that differ only in how they join the observed skeleton."""
LONGEST_WAY_M = 5.0
"""Between a camera and the nearest other one of a scan."""
FARTHEST_M = 1e5
"""From base; beyond, voxels could not be numbered."""
Stage = Callable[[str], AbstractContextManager[None]]


@dataclass(frozen=True, kw_only=True, slots=True)
class MethodConfig:
    """A method by name and the settings of its stages.

    straighten_steps: how often predicted vertices are moved to the mean of their neighbours.
    Method `canopy` uses `canopy` and `likelihood`, the others everything else.
    """

    name: MethodName = DEFAULT_METHOD
    cluster: ClusterConfig = field(default_factory=ClusterConfig)
    spline: SplineConfig = field(default_factory=SplineConfig)
    likelihood: LikelihoodConfig = field(default_factory=LikelihoodConfig)
    initial: InitialConfig = field(default_factory=InitialConfig)
    ftsem: FtsemConfig = field(default_factory=FtsemConfig)
    straighten_steps: int = 10
    canopy: CanopyConfig = field(default_factory=CanopyConfig)

    def __post_init__(self) -> None:
        """Refuse a method that is not known."""
        if self.name not in METHODS:
            raise UsageError(f"unknown method {self.name!r}: choose one of {', '.join(METHODS)}")

    def sha256(self) -> str:
        """Return the hash that names this configuration in documents."""
        fields = asdict(self)
        if self.name != "canopy":
            del fields["canopy"]
        return sha256(json.dumps(fields, sort_keys=True).encode()).hexdigest()


@dataclass(frozen=True, kw_only=True, eq=False, slots=True)
class Extraction:
    """A skeleton and what its making came across: map size in voxels, joins of Algorithm 1.

    preview: the joins are those of a spanning tree instead.
    corrections: of views whose poses were off; lone_views: too far for that (method `canopy`).
    """

    graph: SkeletonGraph
    voxels: int
    observed_components: int
    joins: tuple[Join, ...]
    preview: bool = False
    corrections: tuple[PoseCorrection, ...] = ()
    lone_views: tuple[LoneView, ...] = ()


@dataclass(frozen=True, kw_only=True, eq=False, slots=True)
class _Known:
    """What is kept of a view. shown: how many pieces of wood it shows."""

    camera_in_base: FloatArray
    matched: bool
    splines: list[BranchSpline]
    shown: int
    instances: int
    rejected: list[RejectedInstance]


def models_for(segmenter: Segmenter) -> Mapping[Depth, Models]:
    """Return the shipped confidences of method `canopy` that suit a segmenter's masks.

    Recorded masks are believed more than those of any network, and for each there are models for
    depth that the camera measured and for depth that was matched from stereo pairs.
    """
    return shipped_models()["recorded" if isinstance(segmenter, RecordedSegmenter) else "learned"]


class Skeletonizer:
    """Takes views in any order and gives the skeleton of all views so far."""

    def __init__(
        self,
        segmenter: Segmenter,
        config: MethodConfig,
        *,
        stage: Stage = lambda name: nullcontext(),
        memory_limit_bytes: int = 3 << 30,
        models: Mapping[Depth, Models] | None = None,
    ) -> None:
        """Start without views.

        `stage(name)` is entered around each stage, for whoever wants to time it. `models` of method
        `canopy`: without, `models_for` the segmenter.
        """
        self._segmenter = segmenter
        self._with_maps = WithMaps(segmenter)
        self._config = config
        self._stage = stage
        self._memory_limit_bytes = memory_limit_bytes
        self._models = models or models_for(segmenter)
        self._known: dict[int, _Known] = {}
        self._canopy = CanopyScan(config.canopy)
        self._start()

    def _start(self) -> None:
        config = self._config
        self._map = LikelihoodMap(config.likelihood, self._memory_limit_bytes)
        self._strands = StrandMap(config.likelihood.voxel_size_m, config.initial.smoothing)
        self._search: PathSearch | None = None
        self._initial: SkeletonGraph | None = None
        self._searched: SkeletonGraph | None = None

    @property
    def config(self) -> MethodConfig:
        """The method and its settings."""
        return self._config

    @property
    def views(self) -> tuple[int, ...]:
        """The indices of the views that are in, ascending."""
        return tuple(sorted(self._known))

    @property
    def instances(self) -> int:
        """How many branch instances the segmenter found in all views."""
        return sum(known.instances for known in self._known.values())

    @property
    def rejected(self) -> tuple[RejectedInstance, ...]:
        """Instances, or parts of them, that gave no cluster."""
        return tuple(one for index in self.views for one in self._known[index].rejected)

    def add_view(self, view: View) -> int:
        """Update the map by a view and return how many pieces of wood it showed.

        A view that is already in changes nothing.

        Raises:
            ViewError: the view cannot be used; nothing has changed.
            UsageError: with it the map would not fit into memory; nothing has changed, and other
                views may fit.
        """
        if view.index in self._known:
            return self._known[view.index].shown
        self._check_place(view)
        if self._config.name == "canopy":
            return self._observe(view)
        with self._stage("segment"):
            masks = self._segmenter.segment(view)
            require_masks(view, masks)
        with self._stage("cluster"):
            clusters, rejected = cluster_branches(view, masks, self._config.cluster)
        with self._stage("spline"):
            splines = fit_splines(clusters, self._config.spline)
        with self._stage("likelihood"):
            self._add(splines)
        self._known[view.index] = _Known(
            camera_in_base=view.base_from_camera[:3, 3],
            matched=view.matched,
            splines=splines,
            shown=len(splines),
            instances=len(masks),
            rejected=rejected,
        )
        return len(splines)

    def _observe(self, view: View) -> int:
        maps = None
        with self._stage("segment"):
            if self._config.canopy.use_fragments:
                masks, maps = self._with_maps.segment_and_map(view)
            else:
                masks = self._segmenter.segment(view)
            require_masks(view, masks)
        with self._stage("observe"):
            seen = self._canopy.observe(view, masks, maps)
        with self._stage("likelihood"):
            self._add(seen.splines)
        with self._stage("evidence"):
            self._canopy.add(view.index, seen)
        self._known[view.index] = _Known(
            camera_in_base=view.base_from_camera[:3, 3],
            matched=view.matched,
            splines=seen.splines,
            shown=len(seen.splines) + seen.fragments,
            instances=len(masks),
            rejected=[
                RejectedInstance(
                    view_index=view.index,
                    instance=instance,
                    reason="too few points with trusted depth",
                )
                for instance in seen.dropped
            ],
        )
        return self._known[view.index].shown

    def remove_view(self, index: int) -> None:
        """Take a view off again, as if it had never been in.

        Raises:
            UsageError: it is not in.
        """
        if index not in self._known:
            raise UsageError(f"view {index} is not in, so it cannot be removed")
        gone = self._known.pop(index)
        self._canopy.remove(index)
        if self._map.saturated:
            # What a sum has lost at its limit cannot be told: begin again.
            self._start()
            for known in self._known.values():
                self._add(known.splines)
            return
        segments = segments_of(gone.splines)
        self._map.remove(segments)
        if self._config.name != "canopy":
            self._strands.remove(segments)
        self._initial = None

    def _add(self, splines: list[BranchSpline]) -> None:
        segments = segments_of(splines)
        self._map.add(segments)
        if self._config.name != "canopy":
            self._strands.add(segments)
        self._initial = None

    def _check_place(self, view: View) -> None:
        """Refuse a view from far away: its pose is wrong, and the map would span the way there."""
        here = view.base_from_camera[:3, 3]
        away_m = [float(np.linalg.norm(here - k.camera_in_base)) for k in self._known.values()]
        if max(np.abs(here)) > FARTHEST_M or (away_m and min(away_m) > LONGEST_WAY_M):
            raise ViewError(
                f"view {view.index}: its camera is at ({here[0]:.1f}, {here[1]:.1f}, {here[2]:.1f})"
                f" m, more than {LONGEST_WAY_M:.0f} m from all others; check its pose on /tf, which"
                " must be in metres"
            )

    def skeleton(self, joined_by: MethodName | None = None) -> Extraction:
        """Return the skeleton of all views so far; it does not depend on their order.

        Args:
            joined_by: another method to make the joins by, all before them being the same.

        Raises:
            UsageError: that method differs from this one in more than the joins.
        """
        name = joined_by or self._config.name
        if name != self._config.name and not {name, self._config.name} <= JOINERS:
            raise UsageError(
                f"{name} and {self._config.name} differ before the joins: give each its own"
                " Skeletonizer"
            )
        if name == "canopy":
            with self._stage("canopy"):
                return self._canopy_skeleton()
        initial = self._observed()
        joins: list[Join] = []
        search = self._repaired(initial) if name == "paper" else None
        with self._stage("join"):
            if search is not None:
                joins = search.joins()
                graph = self._joined(initial, joins)
            elif name == "mst":
                graph = join_by_spanning_tree(initial, self._map.voxel_size_m)
            else:
                graph = join_break_points(initial, self._map.voxel_size_m, self._config.ftsem)
        return self._extraction(initial, graph, joins, preview=False)

    def preview(self) -> Extraction:
        """Return a skeleton that is quicker to make and joins nearly the same.

        The baselines have none: theirs is the skeleton itself.
        """
        if self._config.name != "paper":
            return self.skeleton()
        initial = self._observed()
        search = self._repaired(initial)
        with self._stage("preview"):
            joins = search.preview()
            graph = self._joined(initial, joins)
        return self._extraction(initial, graph, joins, preview=True)

    def _observed(self) -> SkeletonGraph:
        """Return G_init."""
        if self._initial is None:
            with self._stage("initial"):
                strands = self._strands.smoothed()
                self._initial = initial_skeleton(strands, self._map, self._config.initial)
        return self._initial

    def _repaired(self, initial: SkeletonGraph) -> PathSearch:
        """Return the search, repaired where views have changed G_init or the map."""
        search = self._search = self._search or PathSearch(self._map)
        if self._searched is not initial:
            with self._stage("repair"):
                search.update(initial)
            self._searched = initial
        return search

    def _joined(self, initial: SkeletonGraph, joins: list[Join]) -> SkeletonGraph:
        graph = add_paths(initial, joins, self._map)
        return straighten_predicted(graph, self._config.straighten_steps)

    def _extraction(
        self, initial: SkeletonGraph, graph: SkeletonGraph, joins: list[Join], *, preview: bool
    ) -> Extraction:
        return Extraction(
            graph=graph,
            voxels=self._map.occupied(),
            observed_components=initial.components()[0],
            joins=tuple(joins),
            preview=preview,
        )

    def _canopy_skeleton(self) -> Extraction:
        matched = any(known.matched for known in self._known.values())
        models = self._models["stereo" if matched else "camera"]
        scan, brought = self._canopy.brought_back(models)
        likelihood = self._map
        if brought:
            try:
                likelihood = self._map_of(scan.splines())
            except UsageError:  # No room for a second map: they stay where they are, and are named.
                scan, brought = self._canopy, []
        joined = skeleton_of(scan, likelihood, models)
        return Extraction(
            graph=joined.graph,
            voxels=likelihood.occupied(),
            observed_components=joined.observed_components,
            joins=(),
            corrections=tuple(one_after_other(brought, joined.corrections)),
            lone_views=joined.lone_views,
        )

    def _map_of(self, splines: list[list[BranchSpline]]) -> LikelihoodMap:
        likelihood = LikelihoodMap(self._config.likelihood, self._memory_limit_bytes)
        for of_view in splines:
            likelihood.add(segments_of(of_view))
        return likelihood
