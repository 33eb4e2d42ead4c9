"""Branch instances in picture files and recordings: what `canopy segment` writes."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from canopy_skel.document import RejectedView
from canopy_skel.errors import UsageError, ViewError
from canopy_skel.exports.instances import draw_instances
from canopy_skel.frame import Intrinsics, UInt8Array, View
from canopy_skel.messages import encode_scores
from canopy_skel.recording import annotate, read_recording
from canopy_skel.segment import BranchMask, Segmenter, painted
from service.outputs import write_all
from service.picture_files import read_picture

_LARGEST_OVERLAY_PX = 4096
_JPEG_QUALITY = 92


@dataclass(frozen=True, kw_only=True, slots=True)
class Segmented:
    """What was found in one source and where it was written; confidences of all instances."""

    source: Path
    files: tuple[Path, ...]
    views: int
    confidences: tuple[float, ...]
    rejected: tuple[RejectedView, ...] = ()
    warnings: tuple[str, ...] = ()

    def to_dict(self) -> dict[str, object]:
        """Return the facts, ready for JSON."""
        return {
            "source": str(self.source),
            "files": [str(file) for file in self.files],
            "views": self.views,
            "instances": len(self.confidences),
            "confidences": [round(one, 4) for one in self.confidences],
            "rejected": [{"index": v.index, "reason": v.reason} for v in self.rejected],
            "warnings": list(self.warnings),
        }


def picture_view(color_rgb: UInt8Array) -> View:
    """Return a view of a picture alone, by a camera of which nothing else is known."""
    height, width = color_rgb.shape[:2]
    lens = Intrinsics(
        fx_px=float(max(height, width)),
        fy_px=float(max(height, width)),
        cx_px=(width - 1) / 2,
        cy_px=(height - 1) / 2,
        width_px=width,
        height_px=height,
    )
    return View(
        index=0, stamp_ns=0, color_rgb=color_rgb, intrinsics=lens, base_from_camera=np.eye(4)
    )


def segment_picture(path: Path, out: Path, segmenter: Segmenter) -> Segmented:
    """Write an overlay, the instances (16-bit png) and their scores of one picture.

    Raises:
        UsageError: the picture cannot be read or segmented, or `out` cannot be written.
    """
    color = read_picture(path)
    try:
        masks = segmenter.segment(picture_view(color))
    except ViewError as error:
        raise UsageError(f"{path}: {error}") from error
    instances, scores = painted(masks, (color.shape[0], color.shape[1]))
    contents = {
        f"{path.stem}.overlay.jpg": _overlay(color, masks),
        f"{path.stem}.instances.png": cv2.imencode(".png", instances)[1].tobytes(),
        f"{path.stem}.scores.json": encode_scores(scores) + b"\n",
    }
    files = tuple(write_all(out, contents))
    return Segmented(source=path, files=files, views=1, confidences=scores)


def _overlay(color_rgb: UInt8Array, masks: Sequence[BranchMask]) -> bytes:
    """Return the overlay as jpeg, made smaller where a viewer could not show it."""
    drawn = draw_instances(color_rgb, masks)
    scale = _LARGEST_OVERLAY_PX / max(drawn.shape[:2])
    if scale < 1:
        size = max(round(drawn.shape[1] * scale), 1), max(round(drawn.shape[0] * scale), 1)
        drawn = np.asarray(cv2.resize(drawn, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)
    quality = [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY]
    return cv2.imencode(".jpg", np.ascontiguousarray(drawn[..., ::-1]), quality)[1].tobytes()


def segment_recording(
    path: Path, out: Path, segmenter: Segmenter, progress: Callable[[int, int], None]
) -> Segmented:
    """Write a copy of a recording with the instances found in its views.

    Raises:
        RecordingError: it cannot be read, its pictures are distorted, or the copy is there already.
    """
    recording = read_recording(path)
    confidences: list[float] = []

    def found(view: View) -> list[BranchMask]:
        masks = list(segmenter.segment(view))
        confidences.extend(mask.confidence for mask in masks)
        return masks

    target = out / path.name
    rejected = annotate(recording, target, found, progress)
    return Segmented(
        source=path,
        files=(target,),
        views=recording.view_count,
        confidences=tuple(confidences),
        rejected=tuple(rejected),
        warnings=recording.warnings,
    )
