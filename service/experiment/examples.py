"""One tree as in the paper's Fig. 7: truth, observed, each method, and the recovered volume."""

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.figure import Figure

from canopy_skel.document import SkeletonDocument
from canopy_skel.exports.palette import OBSERVED_RGB
from canopy_skel.frame import UInt8Array, View
from canopy_skel.geometry import FloatArray
from canopy_skel.metrics.comparison import compare
from canopy_skel.pipeline import MethodName
from canopy_skel.segment import Segmenter
from service.experiment.figures import png
from service.experiment.measure import outcomes_of, read_views, truth_of
from service.experiment.orchard import Tree
from service.experiment.run import MEMORY_LIMIT_BYTES

TOLERANCE_M, SPACING_M = 0.02, 0.008
BLUE = "#{:02x}{:02x}{:02x}".format(*OBSERVED_RGB)
GREEN, RED, GREY, BROWN = "#009E73", "#D55E00", "#8A8A8A", "#7A5230"
COLUMNS = 4
ORDER = ("mst", "ftsem", "paper")


def example(folder: Path, tree: Tree, methods: Sequence[MethodName], segmenter: Segmenter) -> bytes:
    """Draw one tree, side by side, seen from the robot.

    Raises:
        CanopyError: the recording cannot be used, or carries no truth.
    """
    recording, views = read_views(folder / tree.file)
    truth = truth_of(recording)
    outcomes = dict(outcomes_of(views, segmenter, methods, MEMORY_LIMIT_BYTES))
    shown = [name for name in ORDER if name in outcomes]
    shown += [name for name in outcomes if name not in ORDER]
    best = outcomes[shown[-1]]
    picture = _picture(views)
    lines = -(-(4 + len(shown)) // COLUMNS)
    figure = Figure(figsize=(3.0 * COLUMNS, 3.4 * lines), layout="constrained")
    axes = figure.subplots(lines, COLUMNS).ravel()
    axes[0].imshow(picture)
    axes[0].set_title(f"{tree.species}, FD{tree.foliage}")
    _draw_truth(axes[1], truth)
    axes[1].set_title("truth (grey: in no mask)")
    _draw_lines(axes[2], best.observed.position[best.observed.edges], "k")
    axes[2].set_title("observed")
    for ax, name in zip(axes[3:], shown, strict=False):
        figures = _draw_judged(ax, outcomes[name].document, truth)
        ax.set_title(f"{name}: {figures}")
    last = 3 + len(shown)
    _draw_volume(axes[last], best.document)
    axes[last].set_title(f"volume, {shown[-1]}")
    low, high = _extent(truth)
    for ax in axes[1 : last + 1]:
        ax.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal")
    for ax in axes:
        ax.set(xticks=[], yticks=[])
        ax.title.set_fontsize(9)
    for ax in axes[last + 1 :]:
        ax.set_axis_off()
    return png(figure)


def _flat(points: FloatArray) -> FloatArray:
    """Return points (..., 2) as the robot sees them: left is +y, up is +z."""
    return np.stack([-points[..., 1], points[..., 2]], axis=-1)


def _extent(truth: SkeletonDocument) -> tuple[FloatArray, FloatArray]:
    points = _flat(truth.position)
    return points.min(axis=0) - 0.05, points.max(axis=0) + 0.05


def _picture(views: Sequence[View]) -> UInt8Array:
    """Return the picture of the view from furthest away, made smaller."""
    view = min(views, key=lambda view: float(view.base_from_camera[0, 3]))
    size = (view.intrinsics.width_px * 400 // view.intrinsics.height_px, 400)
    small = cv2.resize(view.color_rgb, size, interpolation=cv2.INTER_AREA)
    return np.asarray(small, dtype=np.uint8)


def _draw_truth(ax: Axes, truth: SkeletonDocument) -> None:
    ends = truth.position[truth.edges]
    masked = np.array(truth.extra.get("segmented", (True,) * len(truth.position)), dtype=np.bool_)
    seen = masked[truth.edges].all(axis=1)
    _draw_lines(ax, ends[~seen], GREY)
    _draw_lines(ax, ends[seen], "k")


def _draw_lines(ax: Axes, ends: FloatArray, color: str) -> None:
    ax.add_collection(LineCollection(list(_flat(ends)), colors=[color], linewidths=0.9))


def _draw_judged(ax: Axes, document: SkeletonDocument, truth: SkeletonDocument) -> str:
    """Draw right observed, right predicted and wrong pieces; return precision and recall."""
    both = compare(document, truth, tolerance_m=TOLERANCE_M, spacing_m=SPACING_M)
    pieces = both.out.pieces
    half = 0.5 * pieces.length_m[:, None] * pieces.directions
    ends = np.stack([pieces.points - half, pieces.points + half], axis=1)
    for chosen, color in (
        (both.right & ~both.predicted, BLUE),
        (both.right & both.predicted, GREEN),
        (~both.right, RED),
    ):
        _draw_lines(ax, ends[chosen], color)
    precision, recall, _ = both.counts()
    return f"P {precision or 0:.2f}  R {recall or 0:.2f}"


def _draw_volume(ax: Axes, document: SkeletonDocument) -> None:
    """Draw every edge as a tapered band, thick wood first hidden by what is nearer."""
    ends = document.position[document.edges]
    order = np.argsort(-ends[:, :, 0].mean(axis=1))
    ends, radii = ends[order], document.radius[document.edges][order]
    flat = _flat(ends)
    along = flat[:, 1] - flat[:, 0]
    along /= np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-9)
    across = np.stack([-along[:, 1], along[:, 0]], axis=1)[:, None] * radii[:, :, None]
    bands = np.concatenate([flat + across, (flat - across)[:, ::-1]], axis=1)
    ax.add_collection(PolyCollection(list(bands), facecolors=BROWN, edgecolors="none"))
