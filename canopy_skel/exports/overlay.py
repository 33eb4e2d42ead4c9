"""The skeleton over a colour image: the picture that shows a grower what was found."""

import cv2
import numpy as np
from numpy.typing import ArrayLike

from canopy_skel.document import SkeletonDocument
from canopy_skel.exports.palette import OBSERVED_RGB, OCCLUDED_RGB
from canopy_skel.exports.projection import NEAR_M, Segments, dashed, project_edges
from canopy_skel.frame import UInt8Array, View
from canopy_skel.geometry import FloatArray, invert, transform_points

_Color = tuple[int, int, int]
_DARK: _Color = (12, 12, 12)
_LIGHT: _Color = (250, 250, 250)
_MIN_WIDTH_PX, _MAX_WIDTH_PX = 2, 9
_ON_PX, _OFF_PX = 10.0, 9.0
_BAR_SIZES_M = (0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0)
# Sub-pixel bits of cv2's line drawing.
_SHIFT = 4


def draw_overlay(view: View, document: SkeletonDocument) -> UInt8Array:
    """Return (H, W, 3) uint8 RGB: the view, dimmed, with the skeleton, its root and a legend.

    Observed wood is a solid blue line, occluded (predicted) wood a dashed vermillion one, both
    half as wide as the wood, from two to nine pixels. Nothing hides a line: also what is behind
    leaves in this view is drawn. What is outside the view is cut off.
    """
    image = _dimmed(view.color_rgb)
    segments = project_edges(view, document)
    _draw_segments(image, dashed(segments, _ON_PX, _OFF_PX))
    _draw_root(image, view, document)
    _draw_legend(image, view, document, segments)
    return image


def _dimmed(color_rgb: UInt8Array) -> UInt8Array:
    """Return a copy with little colour, pale, so that the lines alone are strong."""
    gray = cv2.cvtColor(color_rgb, cv2.COLOR_RGB2GRAY).astype(np.float32)[..., None]
    faded = 0.55 * color_rgb + 0.45 * gray
    return np.asarray(60.0 + 0.64 * faded, dtype=np.uint8)


def _draw_segments(image: UInt8Array, segments: Segments) -> None:
    width_px = np.clip(np.round(segments.radius_px), _MIN_WIDTH_PX, _MAX_WIDTH_PX).astype(int)
    starts, ends = _fixed_point(segments.start_px), _fixed_point(segments.end_px)
    colors = [OCCLUDED_RGB if occluded else OBSERVED_RGB for occluded in segments.occluded]
    lines = list(zip(starts, ends, width_px.tolist(), colors, strict=True))
    for start, end, width, _ in lines:
        cv2.line(image, start, end, _DARK, width + 2, cv2.LINE_AA, _SHIFT)
    for start, end, width, color in lines:
        cv2.line(image, start, end, color, width, cv2.LINE_AA, _SHIFT)


def _fixed_point(points_px: FloatArray) -> list[tuple[int, int]]:
    fixed = np.round(points_px * (1 << _SHIFT)).astype(int)
    return [(x, y) for x, y in fixed.tolist()]


def _draw_root(image: UInt8Array, view: View, document: SkeletonDocument) -> None:
    """Mark the root with a ring, or with an arrow at the border that points to it."""
    if document.root is None:
        return
    in_base = document.position[[document.root]]
    in_camera = transform_points(invert(view.base_from_camera), in_base)
    if in_camera[0, 2] < NEAR_M:
        return
    scale = _text_scale(image)
    size = np.array([view.intrinsics.width_px, view.intrinsics.height_px])
    place = view.intrinsics.project(in_camera)[0]
    margin = 16 * scale
    shown = np.clip(place, margin, size - 1 - margin)
    if np.array_equal(shown, place):
        for color, width in ((_DARK, 6 * scale), (_LIGHT, 3 * scale)):
            cv2.circle(image, _pixel(place), round(11 * scale), color, round(width), cv2.LINE_AA)
    else:
        toward = (place - shown) / np.linalg.norm(place - shown)
        tail, head = shown - 34 * scale * toward, shown + 12 * scale * toward
        ends = _pixel(tail), _pixel(head)
        for color, width in ((_DARK, 6 * scale), (_LIGHT, 3 * scale)):
            cv2.arrowedLine(image, *ends, color, round(width), cv2.LINE_AA, tipLength=0.4)
    offset = np.array([20.0, 5.0]) * scale
    room = np.array([_text_width("root", scale), 6 * scale])
    label_at = np.minimum(shown + offset, size - room - 6 * scale)
    _darken(image, label_at - [5 * scale, 16 * scale], label_at + room)
    _write(image, "root", label_at, scale)


def _draw_legend(
    image: UInt8Array, view: View, document: SkeletonDocument, segments: Segments
) -> None:
    """Write what the lines mean, how much there is of each, and a scale bar."""
    scale = _text_scale(image)
    observed_m, occluded_m = _lengths_m(document)
    bar_m, bar_px, distance_m = _scale_bar(view, document)
    title = f"scan {document.scan_id}, revision {document.revision}, view {view.index}"
    texts = [
        f"observed, {observed_m:.1f} m",
        f"occluded, predicted, {occluded_m:.1f} m",
        f"{bar_m:g} m at {distance_m:.1f} m distance",
    ]
    row, pad = 24 * scale, 14 * scale
    indent = bar_px + 2 * pad
    text_width = max(_text_width(text, scale) for text in texts)
    width = max(_text_width(title, scale) + pad, indent + text_width) + pad
    size = np.array([width, row * (len(texts) + 1.5)])
    corner = _free_corner(image, segments, size)
    _darken(image, corner, corner + size)
    left, feet = corner[0] + pad, corner[1] + row * np.arange(1, len(texts) + 2)
    _write(image, title, np.array([left, feet[0]]), scale)
    for text, foot in zip(texts, feet[1:], strict=True):
        _write(image, text, np.array([corner[0] + indent, foot]), scale)
    middle = (feet[1:] - 5 * scale).tolist()
    _draw_segments(image, _samples(left, bar_px, middle[:2], 2.5 * scale))
    _draw_bar(image, left, bar_px, middle[2], scale)


def _free_corner(image: UInt8Array, segments: Segments, size: FloatArray) -> FloatArray:
    """Return the upper left point of the box of this size, in a corner, that hides least."""
    right, low = image.shape[1] - size[0], image.shape[0] - size[1]
    corners = np.array([(0.0, low), (right, low), (right, 0.0), (0.0, 0.0)])
    inside = (segments.end_px >= corners[:, None]) & (segments.end_px <= corners[:, None] + size)
    return np.asarray(corners[np.argmin(inside.all(axis=2).sum(axis=1))])


def _darken(image: UInt8Array, upper_left: FloatArray, lower_right: FloatArray) -> None:
    (x0, y0), (x1, y1) = _pixel(np.maximum(upper_left, 0)), _pixel(lower_right)
    image[y0:y1, x0:x1] = (0.25 * image[y0:y1, x0:x1]).astype(np.uint8)


def _samples(left: float, length: float, heights: list[float], radius_px: float) -> Segments:
    """Return an observed and an occluded line for the legend."""
    samples = Segments(
        start_px=np.array([(left, y) for y in heights]),
        end_px=np.array([(left + length, y) for y in heights]),
        radius_px=np.full(2, radius_px),
        occluded=np.array([False, True]),
        run=np.arange(2),
    )
    return dashed(samples, _ON_PX, _OFF_PX)


def _lengths_m(document: SkeletonDocument) -> tuple[float, float]:
    """Return the length of all observed and of all occluded edges."""
    start, end = document.position[document.edges[:, 0]], document.position[document.edges[:, 1]]
    length_m = np.linalg.norm(end - start, axis=1)
    occluded = document.occluded[document.edges].any(axis=1)
    return float(length_m[~occluded].sum()), float(length_m[occluded].sum())


def _scale_bar(view: View, document: SkeletonDocument) -> tuple[float, float, float]:
    """Return a round length in metres, what it takes in pixels, and at which distance in metres.

    The distance is the median one of the skeleton, 1 m if it has no vertex in front.
    """
    z = transform_points(invert(view.base_from_camera), document.position)[:, 2]
    ahead = z[z > NEAR_M]
    distance_m = float(np.median(ahead)) if len(ahead) else 1.0
    px_per_m = view.intrinsics.fx_px / distance_m
    room_px = 0.15 * view.intrinsics.width_px
    sizes_m = [size for size in _BAR_SIZES_M if size * px_per_m <= room_px]
    bar_m = sizes_m[-1] if sizes_m else _BAR_SIZES_M[0]
    return bar_m, bar_m * px_per_m, distance_m


def _draw_bar(image: UInt8Array, left: float, length: float, y: float, scale: float) -> None:
    tick, width = 4 * scale, max(1, round(2 * scale))
    ends = [((left, y), (left + length, y))]
    ends += [((x, y - tick), (x, y + tick)) for x in (left, left + length)]
    for start, end in ends:
        cv2.line(image, _pixel(start), _pixel(end), _LIGHT, width, cv2.LINE_AA)


def _text_scale(image: UInt8Array) -> float:
    return float(max(0.5, image.shape[0] / 800))


def _text_width(text: str, scale: float) -> int:
    return int(
        cv2.getTextSize(_ascii(text), cv2.FONT_HERSHEY_SIMPLEX, 0.5 * scale, max(1, round(scale)))[
            0
        ][0]
    )


def _write(image: UInt8Array, text: str, left_foot_px: FloatArray, scale: float) -> None:
    font, at, width = cv2.FONT_HERSHEY_SIMPLEX, _pixel(left_foot_px), max(1, round(scale))
    cv2.putText(image, _ascii(text), at, font, 0.5 * scale, _LIGHT, width, cv2.LINE_AA)


def _ascii(text: str) -> str:
    """Return the text with what cv2's font does not have replaced."""
    return text.encode("ascii", "replace").decode()


def _pixel(point_px: ArrayLike) -> tuple[int, int]:
    x, y = np.round(np.asarray(point_px, dtype=np.float64)).astype(int).tolist()
    return x, y
