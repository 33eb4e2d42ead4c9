"""What methods make of one recorded tree, and how far it is from the truth."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from canopy_skel.document import Method, RejectedView, SkeletonDocument, build_document, from_json
from canopy_skel.errors import CanopyError, RecordingError, UsageError, ViewError
from canopy_skel.frame import View
from canopy_skel.geometry import FloatArray
from canopy_skel.graph import SkeletonGraph
from canopy_skel.metrics import score
from canopy_skel.metrics.matching import nearest
from canopy_skel.pipeline import (
    JOINERS,
    Extraction,
    MethodConfig,
    MethodName,
    Skeletonizer,
    models_for,
)
from canopy_skel.recording import Recording, read_recording
from canopy_skel.segment import BranchMask, Segmenter
from canopy_skel.volume import wood_volume_m3
from drivers.stereo import with_depth
from service.experiment.orchard import Tree
from service.experiment.rows import Row, Value
from service.experiment.segmenters import segmenter_named
from service.skeletons import SOFTWARE

FOUND_M = 0.02
"""Truth with a vertex of the output this near counts as found wood."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Task:
    """Rows to make of one tree: methods by segmenter. memory_limit_bytes: of a likelihood map."""

    folder: Path
    tree: Tree
    methods: Mapping[str, tuple[MethodName, ...]]
    memory_limit_bytes: int


@dataclass(frozen=True, kw_only=True, eq=False, slots=True)
class Outcome:
    """What a method made of a tree, and the part of it that was not predicted."""

    document: SkeletonDocument
    observed: SkeletonDocument
    extraction: Extraction
    skeletonizer: Skeletonizer


def rows_of(task: Task) -> list[Row]:
    """Make the rows of one tree; what cannot be done becomes a row with an error."""
    try:
        recording, views = read_views(task.folder / task.tree.file)
        truth = truth_of(recording)
    except CanopyError as error:
        return [row for name in task.methods for row in _failures(task, name, error)]
    rows: list[Row] = []
    for segmenter, methods in task.methods.items():
        try:
            outcomes = outcomes_of(
                views, segmenter_named(segmenter), methods, task.memory_limit_bytes
            )
            for name, outcome in outcomes:
                values = {**figures_of(outcome, truth), "views": len(views)}
                rows.append(_row(task, segmenter, name, values))
        except CanopyError as error:
            rows += _failures(task, segmenter, error)
    return rows


def read_views(path: Path) -> tuple[Recording, list[View]]:
    """Return a recording and its usable views, decoded, with depth.

    Raises:
        RecordingError: it cannot be read.
    """
    recording = read_recording(path)
    views = []
    for view in recording.views():
        if isinstance(view, RejectedView):
            continue
        try:
            views.append(with_depth(view))
        except ViewError:
            continue
    return recording, views


def truth_of(recording: Recording) -> SkeletonDocument:
    """Return the attached true skeleton.

    Raises:
        RecordingError: there is none.
    """
    data = recording.ground_truth
    if data is None:
        raise RecordingError(
            f"{recording.path}: no ground_truth_skeleton.json is attached; use recordings made by"
            " `canopy simulate`"
        )
    return from_json(data, f"{recording.path}: ground_truth_skeleton.json")


class _Once(Segmenter):
    """Segments each view once, whoever asks."""

    def __init__(self, inner: Segmenter) -> None:
        self._inner = inner
        self._masks: dict[int, Sequence[BranchMask]] = {}

    def segment(self, view: View) -> Sequence[BranchMask]:
        """Return the inner segmenter's masks."""
        if view.index not in self._masks:
            self._masks[view.index] = self._inner.segment(view)
        return self._masks[view.index]


def outcomes_of(
    views: Sequence[View],
    segmenter: Segmenter,
    methods: Iterable[MethodName],
    memory_limit_bytes: int,
) -> Iterator[tuple[MethodName, Outcome]]:
    """Yield what each method makes of the views; they share all that they have in common.

    Views that cannot be used are left out; rows say how many were.

    Raises:
        ViewError: none can be used.
    """
    masks = _Once(segmenter)
    for names in _alike(methods):
        front = MethodConfig(name="paper" if len(names) > 1 else names[0])
        skeletonizer = Skeletonizer(
            masks, front, memory_limit_bytes=memory_limit_bytes, models=models_for(segmenter)
        )
        _add_all(skeletonizer, views)
        used = len(skeletonizer.views)
        for name in names:
            extraction = skeletonizer.skeleton(name)
            outcome = Outcome(
                document=_document(extraction.graph, name, used),
                observed=_document(_observed(extraction.graph), name, used),
                extraction=extraction,
                skeletonizer=skeletonizer,
            )
            yield name, outcome


def _add_all(skeletonizer: Skeletonizer, views: Sequence[View]) -> None:
    reasons = []
    for view in views:
        try:
            skeletonizer.add_view(view)
        except (ViewError, UsageError) as error:
            reasons.append(str(error))
    if not skeletonizer.views:
        raise ViewError(f"no view is usable; the first: {reasons[0] if reasons else 'none'}")


def _alike(methods: Iterable[MethodName]) -> list[tuple[MethodName, ...]]:
    """Group the methods that can share a Skeletonizer."""
    methods = tuple(methods)
    joiners = tuple(name for name in methods if name in JOINERS)
    others: list[tuple[MethodName, ...]] = [(name,) for name in methods if name not in JOINERS]
    return [joiners, *others] if joiners else others


def _observed(graph: SkeletonGraph) -> SkeletonGraph:
    """Return the part of a skeleton that was not predicted."""
    kept = np.flatnonzero(~graph.occluded)
    number = np.full(len(graph.occluded), -1)
    number[kept] = np.arange(len(kept))
    edges = number[graph.edges]
    return SkeletonGraph(
        vertices_in_base=graph.vertices_in_base[kept],
        edges=edges[(edges >= 0).all(axis=1)],
        radius_m=graph.radius_m[kept],
        occluded=graph.occluded[kept],
        confidence=graph.confidence[kept],
    )


def _document(graph: SkeletonGraph, name: MethodName, views: int) -> SkeletonDocument:
    config = MethodConfig(name=name)
    method = Method(
        name=name,
        voxel_size_m=config.likelihood.voxel_size_m,
        config_sha256=config.sha256(),
        software=SOFTWARE,
    )
    return build_document(graph, scan_id="tree", revision=views, method=method, views_used=views)


def figures_of(outcome: Outcome, truth: SkeletonDocument) -> dict[str, Value]:
    """Return all figures of an outcome: scores, volumes, what the method came across."""
    document, extraction = outcome.document, outcome.extraction
    scores: dict[str, Value] = dict(score(document, truth).to_dict())
    framed = np.array(truth.extra.get("framed", (True,) * len(truth.position)), dtype=np.bool_)
    found = np.isfinite(nearest(truth.position, document.position, FOUND_M)[0])
    volume_m3, true_m3 = wood_volume_m3(document), wood_volume_m3(truth, among=framed)
    found_m3 = wood_volume_m3(truth, among=framed & found)
    return {
        **scores,
        "volume_m3": volume_m3,
        "volume_observed_m3": wood_volume_m3(outcome.observed),
        "volume_true_m3": true_m3,
        "volume_found_m3": found_m3,
        "volume_error": (volume_m3 - true_m3) / true_m3 if true_m3 > 0 else None,
        "volume_found_error": (volume_m3 - found_m3) / found_m3 if found_m3 > 0 else None,
        "instances": outcome.skeletonizer.instances,
        "instances_rejected": len(outcome.skeletonizer.rejected),
        "views_used": len(outcome.skeletonizer.views),
        "observed_components": extraction.observed_components,
        "observed_length_m": _length_m(outcome.observed),
        "map_voxels": extraction.voxels,
    }


def _length_m(document: SkeletonDocument) -> float:
    ends: FloatArray = document.position[document.edges]
    return float(np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1).sum())


def _row(task: Task, segmenter: str, name: MethodName, values: Mapping[str, Value]) -> Row:
    return Row(
        tree=task.tree,
        segmenter=segmenter,
        method=name,
        config_sha256=MethodConfig(name=name).sha256(),
        values=values,
    )


def _failures(task: Task, segmenter: str, error: CanopyError) -> list[Row]:
    return [_row(task, segmenter, name, {"error": str(error)}) for name in task.methods[segmenter]]
