"""Views in, one growing likelihood map, a skeleton out: the whole method in the paper's order."""

import json
from collections.abc import Callable, Sequence
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
from canopy_skel.confidence import shipped_models
from canopy_skel.errors import UsageError, ViewError
from canopy_skel.frame import View
from canopy_skel.geometry import FloatArray
from canopy_skel.graph import SkeletonGraph
from canopy_skel.initial import InitialConfig, initial_skeleton
from canopy_skel.likelihood import LikelihoodConfig, LikelihoodMap, VoxelIndex, segments_of
from canopy_skel.pathsearch import Join, add_paths, search_paths, straighten_predicted
from canopy_skel.poses import PoseCorrection
from canopy_skel.segment import BranchMask, Segmenter
from canopy_skel.spline import BranchSpline, SplineConfig, fit_spline
from canopy_skel.wood import wood_of

MethodName = Literal["canopy", "paper", "mst", "ftsem"]
METHODS: tuple[MethodName, ...] = get_args(MethodName)
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

    name: MethodName = "paper"
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

    corrections: of views whose poses were off (method `canopy`).
    """

    graph: SkeletonGraph
    voxels: int
    observed_components: int
    joins: tuple[Join, ...]
    corrections: tuple[PoseCorrection, ...] = ()


class Skeletonizer:
    """Takes views in any order and gives the skeleton of all views so far."""

    def __init__(
        self,
        segmenter: Segmenter,
        config: MethodConfig,
        *,
        stage: Stage = lambda name: nullcontext(),
        memory_limit_bytes: int = 3 << 30,
    ) -> None:
        """`stage(name)` is entered around each stage, for whoever wants to time it."""
        self._segmenter = segmenter
        self._config = config
        self._stage = stage
        self._map = LikelihoodMap(config.likelihood, memory_limit_bytes)
        self._splines: dict[int, list[BranchSpline]] = {}
        self._cameras: dict[int, FloatArray] = {}
        self._instances = 0
        self._rejected: list[RejectedInstance] = []
        self._canopy = CanopyScan(config.canopy)

    @property
    def config(self) -> MethodConfig:
        """The method and its settings."""
        return self._config

    @property
    def views(self) -> tuple[int, ...]:
        """The indices of the views that are in, ascending."""
        return tuple(sorted(self._splines))

    @property
    def instances(self) -> int:
        """How many branch instances the segmenter found in all views."""
        return self._instances

    @property
    def rejected(self) -> tuple[RejectedInstance, ...]:
        """Instances, or parts of them, that gave no cluster."""
        return tuple(self._rejected)

    def add_view(self, view: View) -> int:
        """Update the map by a view and return how many pieces of wood it showed.

        A view that is already in changes nothing.

        Raises:
            ViewError: the view cannot be used; nothing has changed.
            UsageError: the map would not fit into memory; nothing has changed.
        """
        if view.index in self._splines:
            return len(self._splines[view.index])
        self._check_place(view)
        with self._stage("segment"):
            masks = self._segmenter.segment(view)
        if self._config.name == "canopy":
            return self._observe(view, masks)
        with self._stage("cluster"):
            clusters, rejected = cluster_branches(view, masks, self._config.cluster)
        with self._stage("spline"):
            splines = [fit_spline(cluster, self._config.spline) for cluster in clusters]
        with self._stage("likelihood"):
            self._map.add(segments_of(splines))
        self._splines[view.index] = splines
        self._cameras[view.index] = view.base_from_camera[:3, 3]
        self._instances += len(masks)
        self._rejected.extend(rejected)
        return len(splines)

    def _observe(self, view: View, masks: Sequence[BranchMask]) -> int:
        with self._stage("observe"):
            seen = self._canopy.observe(view, masks, wood_of(self._segmenter, view))
        with self._stage("likelihood"):
            self._map.add(segments_of(seen.splines))
        with self._stage("evidence"):
            self._canopy.add(view.index, seen)
        self._splines[view.index] = seen.splines
        self._cameras[view.index] = view.base_from_camera[:3, 3]
        self._instances += len(masks)
        self._rejected.extend(
            RejectedInstance(
                view_index=view.index, instance=instance, reason="too few points with trusted depth"
            )
            for instance in seen.dropped
        )
        return len(seen.splines)

    def _check_place(self, view: View) -> None:
        """Refuse a view from far away: its pose is wrong, and the map would span the way there."""
        here = view.base_from_camera[:3, 3]
        away_m = [float(np.linalg.norm(here - there)) for there in self._cameras.values()]
        if max(np.abs(here)) > FARTHEST_M or (away_m and min(away_m) > LONGEST_WAY_M):
            raise ViewError(
                f"view {view.index}: its camera is at ({here[0]:.1f}, {here[1]:.1f}, {here[2]:.1f})"
                f" m, more than {LONGEST_WAY_M:.0f} m from all others; check its pose on /tf, which"
                " must be in metres"
            )

    def skeleton(self) -> Extraction:
        """Return the skeleton of all views so far; it does not depend on their order."""
        if self._config.name == "canopy":
            with self._stage("canopy"):
                return self._canopy_skeleton()
        splines = [spline for index in self.views for spline in self._splines[index]]
        with self._stage("initial"):
            grid = self._map.grid()
            index = VoxelIndex(grid.voxels)
            initial = initial_skeleton(segments_of(splines), grid, index, self._config.initial)
        joins: list[Join] = []
        with self._stage("join"):
            if self._config.name == "mst":
                graph = join_by_spanning_tree(initial, grid.voxel_size_m)
            elif self._config.name == "ftsem":
                graph = join_break_points(initial, grid.voxel_size_m, self._config.ftsem)
            else:
                joins = search_paths(initial, grid, index)
                graph = add_paths(initial, joins, grid, index)
                graph = straighten_predicted(graph, self._config.straighten_steps)
        return Extraction(
            graph=graph,
            voxels=len(grid.voxels),
            observed_components=initial.components()[0],
            joins=tuple(joins),
        )

    def _canopy_skeleton(self) -> Extraction:
        joined = skeleton_of(self._canopy, self._map, shipped_models())
        return Extraction(
            graph=joined.graph,
            voxels=self._map.occupied(),
            observed_components=joined.observed_components,
            joins=(),
            corrections=joined.corrections,
        )
