"""A recording becomes a skeleton and its files: the offline walk of a scan."""

import json
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np

from canopy_skel.document import RejectedView, SkeletonDocument
from canopy_skel.errors import RecordingError, UsageError, ViewError
from canopy_skel.exports import FORMATS
from canopy_skel.exports.overlay import draw_overlay
from canopy_skel.frame import View
from canopy_skel.pipeline import Extraction, MethodConfig, Skeletonizer, models_for
from canopy_skel.recording import Recording, TopicOptions, read_recording
from drivers.stereo import with_depth
from service.ahead import Ahead
from service.outputs import write_all
from service.segmenters import NAMES, make_segmenter
from service.skeletons import document_of
from service.stopwatch import Stopwatch

_MOST_MAP_MEMORY = 3 << 30


@dataclass(frozen=True, kw_only=True, slots=True)
class ReplayRequest:
    """What to replay a recording with.

    memory_limit_bytes: for the likelihood map. weights: of the segmenter, if not its own.
    """

    config: MethodConfig
    segmenter: str
    formats: tuple[str, ...]
    topics: TopicOptions | None
    memory_limit_bytes: int
    weights: Path | None = None

    def __post_init__(self) -> None:
        """Refuse names that are not known."""
        if self.segmenter not in NAMES:
            known = ", ".join(NAMES)
            raise UsageError(f"unknown segmenter {self.segmenter!r}: choose one of {known}")
        for name in self.formats:
            if name not in FORMATS:
                raise UsageError(f"unknown format {name!r}: choose from {', '.join(FORMATS)}")


@dataclass(kw_only=True, slots=True)
class _Walk:
    """What has come of the views so far; `picture` is the view that showed most wood.

    no_room: why the map had no room for the first view that was lost so.
    """

    skeletonizer: Skeletonizer
    rejected: list[RejectedView] = field(default_factory=list)
    no_room: UsageError | None = None
    picture: View | None = None
    most_pieces: int = -1


@dataclass(frozen=True, kw_only=True, slots=True)
class ReplayResult:
    """Where the files are, and whether all of the recording could be used."""

    files: tuple[Path, ...]
    document: SkeletonDocument
    warnings: tuple[str, ...]

    @property
    def complete(self) -> bool:
        """Whether no view was lost, moved by centimetres, or agrees with no other."""
        return not (self.warnings or self.document.views_rejected)


def replay(
    path: Path, out: Path, request: ReplayRequest, progress: Callable[[int, int], None]
) -> ReplayResult:
    """Replay one recording and write its skeleton, overlay and summary into `out`.

    `progress(done, total)` is called after each view.

    Raises:
        RecordingError: the recording cannot be read or has no usable view.
        UsageError: an argument does not fit, or `out` cannot be written.
    """
    stopwatch = Stopwatch()
    with stopwatch("read"):
        recording = read_recording(path, request.topics)
    walk = _walk_views(recording, request, stopwatch, progress)
    extraction = walk.skeletonizer.skeleton()
    with stopwatch("document"):
        document = document_of(
            walk.skeletonizer, extraction, scan_id=recording.scan_id, rejected=walk.rejected
        )
    with stopwatch("export"):
        contents = _files(path.stem, document, walk, request)
    summary = _summary(recording, document, walk, extraction, stopwatch)
    contents[_summary_name(path.stem)] = (
        json.dumps(summary, indent=2, allow_nan=False).encode() + b"\n"
    )
    warnings = [*recording.warnings, *_doubts(path, walk.skeletonizer, extraction)]
    if not document.branches:
        reasons = Counter(instance.reason for instance in walk.skeletonizer.rejected)
        why = ", ".join(f"{count} x {reason}" for reason, count in reasons.most_common())
        warnings.append(
            f"{path.name}: no branch was found in {walk.skeletonizer.instances} instances"
            f" ({why or 'there are none'}); check masks and depth with `canopy inspect`"
        )
    return ReplayResult(
        files=tuple(write_all(out, contents)), document=document, warnings=tuple(warnings)
    )


def map_memory_bytes(available_bytes: int) -> int:
    """Return how much of the memory that a replay has to itself a likelihood map may take."""
    return min(available_bytes // 2, _MOST_MAP_MEMORY)


def file_names(stem: str, formats: Iterable[str]) -> list[str]:
    """Return the names of all files that the replay of a recording may write."""
    return [
        *(_skeleton_name(stem, one) for one in formats),
        _overlay_name(stem),
        _summary_name(stem),
    ]


def _skeleton_name(stem: str, form: str) -> str:
    return f"{stem}.skeleton.{form}"


def _overlay_name(stem: str) -> str:
    return f"{stem}.overlay.png"


def _summary_name(stem: str) -> str:
    return f"{stem}.summary.json"


def _walk_views(
    recording: Recording,
    request: ReplayRequest,
    stopwatch: Stopwatch,
    progress: Callable[[int, int], None],
) -> _Walk:
    segmenter = make_segmenter(request.segmenter, request.weights)
    method = request.config
    maps = method.name == "canopy" and method.canopy.use_fragments
    with Ahead(segmenter, maps=maps) as ahead:
        walk = _Walk(
            skeletonizer=Skeletonizer(
                ahead,
                method,
                stage=stopwatch,
                memory_limit_bytes=request.memory_limit_bytes,
                models=models_for(segmenter),
            )
        )
        for done, view in enumerate(_read_ahead(recording, ahead, stopwatch), start=1):
            _add(walk, view, stopwatch)
            progress(done, recording.view_count)
    if not walk.skeletonizer.views:
        if walk.no_room:
            raise walk.no_room
        reason = walk.rejected[0].reason if walk.rejected else "it holds no view"
        raise RecordingError(f"{recording.path}: no view is usable; the first: {reason}")
    return walk


def _read_ahead(
    recording: Recording, ahead: Ahead, stopwatch: Stopwatch
) -> Iterator[View | RejectedView]:
    """Yield the views; each time the next one is read already, and being segmented."""
    views = recording.views()
    before: View | RejectedView | None = None
    for _ in range(recording.view_count):
        with stopwatch("read"):
            view = next(views)
        if isinstance(view, View):
            ahead.expect(view)
        if before is not None:
            yield before
        before = view
    if before is not None:
        yield before


def _add(walk: _Walk, view: View | RejectedView, stopwatch: Stopwatch) -> None:
    if isinstance(view, RejectedView):
        walk.rejected.append(view)
        return
    try:
        with stopwatch("stereo"):
            view = with_depth(view)
        pieces = walk.skeletonizer.add_view(view)
    except (ViewError, UsageError) as error:
        if isinstance(error, UsageError):  # One false mask can be too large, as in a live scan.
            walk.no_room = walk.no_room or error
        walk.rejected.append(RejectedView(index=view.index, reason=str(error)))
        return
    if pieces > walk.most_pieces:
        walk.picture, walk.most_pieces = view, pieces


def _doubts(path: Path, skeletonizer: Skeletonizer, extraction: Extraction) -> list[str]:
    """Return which views were not where they were said to be, or agree with no other."""
    moved = [
        f"{path.name}: view {skeletonizer.views[one.view]}: its pose is {100 * one.before_m:.0f} cm"
        " off, or the tree moved: taken to where the other views show its wood"
        for one in extraction.corrections
        if one.brought_back
    ]
    return moved + [
        f"{path.name}: view {skeletonizer.views[one.view]}: only {one.along:.0%} of its wood lies"
        f" along that of other views (usually {one.usual:.0%}), and moved by centimetres it does"
        " not fit either: its pose is wrong, it shows another tree, or it looks where no other"
        " does; what it shows is in the skeleton, so look at it or record it anew"
        for one in extraction.lone_views
    ]


def _files(
    stem: str, document: SkeletonDocument, walk: _Walk, request: ReplayRequest
) -> dict[str, bytes]:
    contents = {_skeleton_name(stem, name): FORMATS[name](document) for name in request.formats}
    if walk.picture is not None:
        overlay = draw_overlay(walk.picture, document)
        _, png = cv2.imencode(".png", np.ascontiguousarray(overlay[:, :, ::-1]))
        contents[_overlay_name(stem)] = png.tobytes()
    return contents


def _summary(
    recording: Recording,
    document: SkeletonDocument,
    walk: _Walk,
    extraction: Extraction,
    stopwatch: Stopwatch,
) -> dict[str, object]:
    """Return what the replay came across; timings make it the one file that is not repeatable."""
    skeletonizer = walk.skeletonizer
    reasons = Counter(instance.reason for instance in skeletonizer.rejected)
    return {
        "recording": recording.path.name,
        "scan_id": recording.scan_id,
        "warnings": list(recording.warnings),
        "views": {
            "used": len(skeletonizer.views),
            "rejected": [{"index": v.index, "reason": v.reason} for v in walk.rejected],
        },
        "instances": {"found": skeletonizer.instances, "rejected": dict(sorted(reasons.items()))},
        "map": {
            "voxel_size_m": document.method.voxel_size_m,
            "occupied_voxels": extraction.voxels,
        },
        "joins": {
            "observed_components": extraction.observed_components,
            "components": document.components,
            "paths": [
                {"cost_nat": round(join.cost_nat, 4), "voxels": len(join.voxels)}
                for join in extraction.joins
            ],
        },
        "poses": [
            {
                "moved_mm" if one.brought_back else "before_mm": round(1000 * one.before_m, 2),
                "after_mm": round(1000 * one.after_m, 2),
                "view": skeletonizer.views[one.view],
            }
            for one in extraction.corrections
        ],
        "skeleton": {
            "vertices": len(document.position),
            "branches": len(document.branches),
            "length_m": round(sum(branch.length for branch in document.branches), 3),
            "occluded_vertices": int(document.occluded.sum()),
        },
        "seconds": {name: round(value, 3) for name, value in stopwatch.seconds.items()},
    }
