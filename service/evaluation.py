"""How good a segmenter is: on labelled pictures, on recordings, and for the skeleton in the end."""

import platform
import tempfile
import time
from collections.abc import Iterable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from canopy_skel.document import SkeletonDocument, from_json
from canopy_skel.errors import RecordingError
from canopy_skel.frame import View
from canopy_skel.metrics import score
from canopy_skel.metrics.segmentation import (
    Judgement,
    SegmentationScores,
    judge,
    segmentation_scores,
)
from canopy_skel.pipeline import MethodConfig
from canopy_skel.recording import Recording, read_recording
from canopy_skel.segment import Segmenter, painted
from canopy_skel.segmenters.labels import LabelledImage, line_of_mask
from canopy_skel.segmenters.recorded import RecordedSegmenter
from service.replay import ReplayRequest, replay
from service.segmenting import picture_view

_SKELETON_FIGURES = ("precision", "recall", "osr", "precision_length", "recall_length")


@dataclass(frozen=True, kw_only=True, slots=True)
class Pace:
    """How long a segmenter takes for a picture: medians of wall and processor milliseconds.

    size_px: median width and height. cpu: model of the processor.
    """

    wall_ms: float
    cpu_ms: float
    size_px: tuple[int, int]
    cpu: str


@dataclass(frozen=True, kw_only=True, slots=True)
class Evaluation:
    """What came of it. skeleton: by segmenter, figures of `canopy score`; empty without a truth."""

    source: str
    scores: SegmentationScores
    pace: Pace
    skeleton: dict[str, dict[str, float | None]]

    def to_dict(self) -> dict[str, object]:
        """Return all figures, ready for JSON."""
        return {
            "source": self.source,
            "scores": self.scores.to_dict(),
            "pace": asdict(self.pace),
            "skeleton": self.skeleton,
        }


def evaluate(
    images: Iterable[LabelledImage], segmenter: Segmenter, threshold: float
) -> tuple[SegmentationScores, Pace]:
    """Segment labelled pictures and compare. The segmenter should report however unsure it is.

    The first picture is segmented once before, as compiling belongs to no picture.
    """
    judgements: list[Judgement] = []
    wall_ms, cpu_ms, sizes = [], [], []
    for image in images:
        view = picture_view(image.color_rgb)
        if not judgements:
            segmenter.segment(view)
        wall, cpu = time.perf_counter(), time.process_time()
        found = segmenter.segment(view)
        cpu_ms.append(1e3 * (time.process_time() - cpu))
        wall_ms.append(1e3 * (time.perf_counter() - wall))
        sizes.append(image.color_rgb.shape[:2])
        judgements.append(judge(found, image, threshold=threshold))
    height, width = np.median(sizes, axis=0) if sizes else (0, 0)
    pace = Pace(
        wall_ms=round(float(np.median(wall_ms or [0])), 1),
        cpu_ms=round(float(np.median(cpu_ms or [0])), 1),
        size_px=(int(width), int(height)),
        cpu=processor(),
    )
    return segmentation_scores(judgements), pace


def processor() -> str:
    """Return the model of this machine's processor."""
    info = Path("/proc/cpuinfo")
    if info.exists():
        for line in info.read_text().splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()


def recorded_labels(recording: Recording) -> Iterator[LabelledImage]:
    """Yield the views of a recording with the instances it holds as labels.

    Raises:
        RecordingError: no view has instances.
    """
    segmenter, found = RecordedSegmenter(), False
    for view in recording.views():
        if isinstance(view, View) and view.instances is not None and view.scores is not None:
            found = True
            yield _labels(view, segmenter)
    if not found:
        raise RecordingError(
            f"{recording.path}: holds no branch instances to compare with; evaluate on labelled"
            " pictures (--coco or --labelme)"
        )


def _labels(view: View, segmenter: RecordedSegmenter) -> LabelledImage:
    masks = [mask for mask in segmenter.segment(view) if mask.mask.sum() > 1]
    size = view.intrinsics.height_px, view.intrinsics.width_px
    lines = tuple(
        line_of_mask(mask.mask) + np.array([mask.left_px, mask.top_px, 0.0]) for mask in masks
    )
    return LabelledImage(
        color_rgb=view.color_rgb,
        instances=painted(masks, size)[0],
        lines=lines,
        ignore=np.zeros(size, dtype=np.bool_),
    )


def skeletons(
    recording: Recording, segmenter: str, weights: Path | None, memory_limit_bytes: int
) -> dict[str, dict[str, float | None]]:
    """Return the figures of skeletons from recorded and from found instances, and their ratio.

    Empty where the recording has no true skeleton attached.

    Raises:
        RecordingError: no view is usable with one of them.
    """
    data = recording.ground_truth
    if data is None:
        return {}
    truth = from_json(data, f"{recording.path}: its true skeleton")
    result: dict[str, dict[str, float | None]] = {}
    for name, own in (("recorded", None), (segmenter, weights)):
        request = ReplayRequest(
            config=MethodConfig(name="paper"),
            segmenter=name,
            weights=own,
            formats=("json",),
            topics=None,
            memory_limit_bytes=memory_limit_bytes,
        )
        with tempfile.TemporaryDirectory() as folder:
            document = replay(recording.path, Path(folder), request, lambda done, total: None)
        result[name] = _figures(document.document, truth)
    base, found = result["recorded"], result[segmenter]
    result["ratio"] = {
        name: (found[name] or 0.0) / value if value else None for name, value in base.items()
    }
    return result


def _figures(document: SkeletonDocument, truth: SkeletonDocument) -> dict[str, float | None]:
    figures = score(document, truth)
    return {name: getattr(figures, name) for name in _SKELETON_FIGURES}


def evaluate_recording(
    path: Path,
    segmenter: Segmenter,
    threshold: float,
    *,
    name: str,
    weights: Path | None,
    memory_limit_bytes: int,
) -> Evaluation:
    """Compare with the instances a recording holds, and the skeletons that come of both.

    Raises:
        RecordingError: it cannot be read, or holds no instances.
    """
    recording = read_recording(path)
    scores, pace = evaluate(recorded_labels(recording), segmenter, threshold)
    ends = skeletons(recording, name, weights, memory_limit_bytes)
    return Evaluation(source=str(path), scores=scores, pace=pace, skeleton=ends)
