"""Draw the figures of docs/method.md from a recording, by the code that the page describes.

    python docs/figures.py [RECORDING.mcap] [--output FOLDER]

or `make figures RECORDING=...`; the bundled recordings/demo_apple.mcap is the default. What each
figure shows (which mask, which gap) is chosen in walkthrough.py, so any recording will do.
"""

import argparse
import io
from dataclasses import replace
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib import pyplot as plt
from matplotlib.collections import LineCollection
from matplotlib.patches import Rectangle
from PIL import Image
from walkthrough import (
    CONFIG,
    Instance,
    Walk,
    busiest_fork,
    busiest_view,
    gap_m,
    greatest_difference,
    path_points,
    profile_of,
    strongest_segments,
    telling_instance,
    telling_join,
    walk_through,
)

from canopy_skel.cluster import principal_axes
from canopy_skel.document import Method, build_document
from canopy_skel.exports.overlay import draw_overlay
from canopy_skel.exports.palette import OBSERVED_RGB, OCCLUDED_RGB
from canopy_skel.geometry import BoolArray, FloatArray
from canopy_skel.graph import SkeletonGraph
from canopy_skel.initial import consolidate
from canopy_skel.kernels.ellipsoid import rows_on_segments
from canopy_skel.segmenters.recorded import RecordedSegmenter
from canopy_skel.spline import fit_splines
from canopy_skel.strands import sample_segments

ROOT = Path(__file__).parents[1]
MAX_BYTES = 250_000
# Okabe & Ito, "Color universal design" (2008), as canopy_skel/exports/palette.py.
BLUE, VERMILLION = (tuple(v / 255 for v in rgb) for rgb in (OBSERVED_RGB, OCCLUDED_RGB))
ORANGE, SKY, GREEN, PURPLE, GREY = "#E69F00", "#56B4E9", "#009E73", "#CC79A7", "#9A9A9A"
CYCLE = [BLUE, ORANGE, GREEN, PURPLE, SKY, VERMILLION, "#000000"]


def draw_masks(walk: Walk) -> plt.Figure:
    """Figure 1: a view and the masks of its branches."""
    view = busiest_view(walk)
    masks = RecordedSegmenter().segment(view)
    gray = view.color_rgb.mean(axis=2, keepdims=True)
    image = (110 + 0.55 * (0.5 * view.color_rgb + 0.5 * gray)) / 255.0
    painted = image.copy()
    for number, mask in enumerate(masks):
        v, u = np.nonzero(mask.mask)
        painted[v + mask.top_px, u + mask.left_px] = mpl.colors.to_rgb(CYCLE[number % 6])
    figure, axes = plt.subplots(1, 2, figsize=(10, 3.65))
    for ax, picture, title in (
        (axes[0], view.color_rgb, f"view {view.index} of {len(walk.views)}"),
        (axes[1], np.clip(painted, 0, 1), f"its {len(masks)} branch instances"),
    ):
        ax.imshow(picture)
        ax.set(xticks=[], yticks=[], title=title)
    return figure


def draw_cluster(walk: Walk) -> plt.Figure:
    """Figure 2: one cluster from pixels to a centre line."""
    one = telling_instance(walk)
    v, u, along, disparity, trusted = profile_of(one)
    figure, axes = plt.subplots(2, 2, figsize=(10, 8))
    picture = axes[0, 0]
    picture.imshow(one.view.color_rgb)
    picture.scatter(u[trusted], v[trusted], s=3, color=BLUE, linewidths=0)
    picture.scatter(u[~trusted], v[~trusted], s=3, color=VERMILLION, linewidths=0)
    height, width = one.view.color_rgb.shape[:2]
    picture.set(xlim=(max(u.min() - 40, 0), min(u.max() + 40, width - 1)))
    picture.set(ylim=(min(v.max() + 15, height - 1), max(v.min() - 15, 0)))
    picture.set(xticks=[], yticks=[], title=f"(a) mask, c = {one.mask.confidence:.2f}")
    ax = axes[0, 1]
    ax.scatter(along[~trusted], disparity[~trusted], s=6, color=VERMILLION, label="cut")
    ax.scatter(along[trusted], disparity[trusted], s=4, color=BLUE, label="trusted")
    grid = np.linspace(along.min(), along.max(), 100)
    fit = np.polyval(np.polyfit(along[trusted], disparity[trusted], 2), grid)
    # The tolerance grows with the square of the distance beyond 1.25 m, as stereo noise does.
    tolerance = CONFIG.cluster.tolerance_m * np.maximum(fit, 0.8) ** 2
    ax.plot(grid, fit, "k", lw=1.5, label="profile, ± tolerance")
    for side in (-1, 1):
        ax.plot(grid, fit + side * tolerance, "k--", lw=1)
    ax.set(xlabel="along the mask (px)", ylabel="disparity 1/z (1/m)")
    ax.set_title(f"(b) {np.mean(~trusted):.0%} is cut by the profile")
    legend_above(ax)
    draw_spline(one, axes[1])
    return figure


def draw_spline(one: Instance, axes: np.ndarray) -> None:
    """Draw the cluster across the ray (radius) and along it (shift to the centre line)."""
    points, controls = one.cluster.points_in_base, one.spline.control_points_in_base
    unshifted = replace(CONFIG.spline, centre_shift=0.0)
    on_surface = fit_splines([one.cluster], unshifted)[0].control_points_in_base
    shift = (controls - on_surface)[0]
    ray = shift / np.linalg.norm(shift)
    axis = principal_axes(points)[1][0]
    sideways = np.cross(ray, axis)
    origin, radius_mm = points.mean(axis=0), one.spline.radius_m * 1000

    def mm(places: FloatArray, direction: FloatArray) -> FloatArray:
        return np.asarray((places - origin) @ direction * 1000)

    for ax, direction in zip(axes, (sideways, ray), strict=True):
        ax.scatter(mm(points, axis), mm(points, direction), s=3, color=SKY, linewidths=0)
        x = mm(on_surface, axis)
        ax.plot(x, mm(on_surface, direction), "o-", color="k", ms=7, label="spline, 4 points")
        ax.set(xlabel="along PC1 (mm)")
    middle = mm(on_surface, sideways)
    axes[0].fill_between(
        x, middle - radius_mm, middle + radius_mm, color=GREEN, alpha=0.25, lw=0,
        label=f"± r = {radius_mm:.0f} mm",
    )  # fmt: skip
    axes[0].set(ylabel="across the ray (mm)", title="(c) seen by the camera: radius")
    axes[1].plot(
        mm(controls, axis), mm(controls, ray), "s-", color=VERMILLION, ms=7, label="centre line"
    )
    for a, b in zip(on_surface, controls, strict=True):
        ends = np.stack([a, b])
        axes[1].plot(mm(ends, axis), mm(ends, ray), ":", color=VERMILLION)
    title = f"(d) from the side: shift π/4 · r = {np.linalg.norm(shift) * 1000:.0f} mm"
    axes[1].set(ylabel="away from the camera (mm)", title=title)
    for ax in axes:
        legend_above(ax)


def legend_above(ax: plt.Axes) -> None:
    """Put the legend inside, above all that is drawn."""
    low, high = ax.get_ylim()
    ax.set_ylim(low, high + 0.3 * (high - low))
    ax.legend(loc="upper center", ncols=3, fontsize=11, columnspacing=0.8, handlelength=1.2)


def draw_likelihood(walk: Walk) -> plt.Figure:
    """Figure 3: the map around a gap, what two segments put into it, and the path through it."""
    join = telling_join(walk)
    path, length_m = path_points(walk, join), gap_m(walk, join)
    near_end, far_end = (
        strongest_segments(walk.segments, part, CONFIG.likelihood.k)
        for part in np.array_split(path, 2)
    )
    pair = [int(near_end[0]), int(far_end[far_end != near_end[0]][0])]
    ends = [walk.segments.starts_in_base[pair], walk.segments.ends_in_base[pair]]
    image, extent = projected_map(walk, path, np.concatenate([path, *ends]), max(0.16, length_m))
    figure, ax = plt.subplots(figsize=(9, 8.2))
    shown = ax.imshow(image.T, origin="lower", extent=extent, cmap="Greys", vmin=0, vmax=1.25)
    bar = figure.colorbar(shown, ax=ax, shrink=0.8, boundaries=np.linspace(0, 1, 101))
    bar.set_label(r"$p_\ell$, greatest over the depth of what is drawn")
    bar.set_ticks([0, 0.5, 1])
    for number, color in zip(pair, (BLUE, GREEN), strict=True):
        draw_ellipsoid(walk, ax, number, color)
    ax.plot(
        *walk.flat(path).T, "o-", color=VERMILLION, ms=4, label=f"path, {join.cost_nat:.2f} nat"
    )
    ax.set(xlim=extent[:2], ylim=extent[2:], xlabel="base (m)", ylabel="base (m)")
    ax.set_title(f"a gap of {length_m * 1000:.0f} mm in the likelihood map")
    figure.legend(*ax.get_legend_handles_labels(), loc="outside lower center", fontsize=11)
    return figure


def projected_map(
    walk: Walk, path: FloatArray, deep: FloatArray, half_m: float
) -> tuple[FloatArray, tuple[float, ...]]:
    """Return the greatest p_l over the depths of `deep` around a path, and where it lies (m)."""
    voxel_m, drop = walk.grid.voxel_size_m, walk.hidden
    places, center = walk.grid.centres_in_base(), path.mean(axis=0)
    low, high = center - half_m, center + half_m
    low[drop], high[drop] = deep[:, drop].min() - voxel_m, deep[:, drop].max() + voxel_m
    near = ((places >= low) & (places <= high)).all(axis=1)
    cells = walk.grid.voxels[near][:, walk.shown]
    first = cells.min(axis=0)
    image = np.zeros(cells.max(axis=0) - first + 1)
    np.maximum.at(image, tuple((cells - first).T), walk.grid.probability()[near])
    (x, y), (width, height) = first * voxel_m, np.array(image.shape) * voxel_m
    return image, (x, x + width, y, y + height)


def draw_ellipsoid(walk: Walk, ax: plt.Axes, number: int, color: object) -> None:
    """Draw a segment, its rule 1 voxels and the contours p_o = 2c/3, c/3 and 0 (k = 3)."""
    start, end = walk.segments.starts_in_base[number], walk.segments.ends_in_base[number]
    radius_m, confidence = walk.segments.radius_m[number], walk.segments.confidence[number]
    voxel_m = walk.grid.voxel_size_m
    length_vx = float(np.linalg.norm(end - start)) / voxel_m
    packed = [*start / voxel_m, *(end - start) / voxel_m / length_vx, length_vx]
    rows = rows_on_segments(np.array([[*packed, radius_m / voxel_m, confidence]]))
    for voxel in rows[:, 1:4][:, walk.shown]:
        ax.add_patch(Rectangle(voxel * voxel_m, voxel_m, voxel_m, fill=False, ec=color, lw=0.9))
    a, b = walk.flat(np.stack([start, end]))
    length_m = float(np.linalg.norm(b - a))
    axis = (b - a) / length_m
    normal = np.array([-axis[1], axis[0]])
    for level in range(1, int(CONFIG.likelihood.k) + 1):
        t = np.linspace(-level, 1 + level, 400)
        past = np.maximum(0.0, np.maximum(-t, t - 1))
        rho = radius_m * np.sqrt(np.maximum(level**2 - past**2, 0.0))
        upper = a + t[:, None] * length_m * axis + rho[:, None] * normal
        lower = a + t[:, None] * length_m * axis - rho[:, None] * normal
        ring = np.concatenate([upper, lower[::-1]])
        ax.plot(*ring.T, color=color, lw=1.8 if level == 3 else 1.0, ls="-" if level == 3 else "--")
    label = (
        f"segment: c = {confidence:.2f}, l = {length_m * 1000:.0f}, r = {radius_m * 1000:.0f} mm"
    )
    ax.plot(*np.stack([a, b]).T, color=color, lw=3, label=label)


def edge_lines(walk: Walk, graph: SkeletonGraph, chosen: BoolArray | None = None) -> FloatArray:
    """Return (E, 2, 2): edges in the plane shown."""
    edges = graph.edges if chosen is None else graph.edges[chosen]
    return walk.flat(graph.vertices_in_base)[edges]


def draw_initial(walk: Walk) -> plt.Figure:
    """Figure 4: from samples to the initial skeleton."""
    centre, voxel_m = busiest_fork(walk), walk.grid.voxel_size_m
    samples, *_ = sample_segments(walk.segments, 0.5 * voxel_m)
    vertices, _ = consolidate(walk.smoothed, voxel_m)
    figure, axes = plt.subplots(2, 2, figsize=(10, 9), sharex=True, sharey=True)
    for ax, points, title in (
        (axes[0, 0], samples, "(a) samples of all segments"),
        (
            axes[0, 1],
            walk.smoothed.points_in_base,
            f"(b) strands, smoothed in {CONFIG.initial.smoothing.steps} steps",
        ),
        (axes[1, 0], vertices, "(c) one vertex per voxel"),
        (axes[1, 1], walk.initial.vertices_in_base, "(d) G_init: spanning forest, spurs cut"),
    ):
        near = (np.abs(points - centre) < 0.1).all(axis=1)
        flat = (walk.flat(points[near]) - centre[walk.shown]) * 1000
        ax.scatter(*flat.T, s=14, color=BLUE, linewidths=0, alpha=0.7)
        ax.set_title(f"{title}: {near.sum()}")
        ax.set(xlim=(-100, 100), ylim=(-100, 100), aspect="equal")
    lines = (edge_lines(walk, walk.initial) - centre[walk.shown]) * 1000
    near = (np.abs(walk.initial.vertices_in_base[walk.initial.edges] - centre) < 0.1).all(
        axis=(1, 2)
    )
    axes[1, 1].add_collection(LineCollection(lines[near], colors="k", lw=1.5))
    figure.supxlabel("mm")
    figure.supylabel("mm")
    return figure


def draw_search(walk: Walk) -> plt.Figure:
    """Figure 5: the components before Algorithm 1, its paths and their costs after it."""
    count, component = walk.initial.components()
    wide, high = np.ptp(walk.flat(walk.initial.vertices_in_base), axis=0)
    size = (11, 4.6 * high / wide + 1.3)
    figure, axes = plt.subplots(1, 2, figsize=size, sharex=True, sharey=True)
    colors = [CYCLE[c % len(CYCLE)] for c in component[walk.initial.edges[:, 0]]]
    axes[0].add_collection(LineCollection(edge_lines(walk, walk.initial), colors=colors, lw=2.2))
    axes[0].set_title(f"before: {count} subgraphs")
    axes[1].add_collection(LineCollection(edge_lines(walk, walk.initial), colors=GREY, lw=1.8))
    left = walk.results["paper"].components()[0]
    axes[1].set_title(f"after {len(walk.joins)} joins: {left} left")
    costs = np.array([join.cost_nat for join in walk.joins])
    norm = mpl.colors.LogNorm(max(costs.min(), 1e-2), costs.max())
    # Without the palest fifth, which white paper would swallow.
    cmap = mpl.colors.ListedColormap(mpl.colormaps["plasma_r"](np.linspace(0.2, 1, 256)))
    flats = [walk.flat(path_points(walk, join)) for join in walk.joins]
    paths = LineCollection(flats, array=np.maximum(costs, 1e-2), norm=norm, cmap=cmap, lw=3.5)
    axes[1].add_collection(paths)
    order = np.argsort(costs, kind="stable")
    for rank in (len(order) // 4, len(order) // 2, 3 * len(order) // 4, len(order) - 1):
        middle = flats[order[rank]][len(flats[order[rank]]) // 2]
        axes[1].annotate(
            f"{costs[order[rank]]:.2f}", middle, xytext=(14, 14), textcoords="offset points",
            arrowprops={"arrowstyle": "-", "color": "k"}, bbox={"fc": "w", "ec": "k", "pad": 2},
        )  # fmt: skip
    for ax in axes:
        ax.autoscale_view()
        ax.set(aspect="equal", xlabel="base (m)")
    axes[0].set_ylabel("base (m)")
    bar = figure.colorbar(paths, ax=axes, pad=0.02, shrink=0.8, format="%g")
    bar.set_label("cost of the path (nat)")
    return figure


def draw_result(walk: Walk) -> plt.Figure:
    """Figure 6: the overlay that `canopy replay` writes."""
    document = build_document(
        walk.results["paper"],
        scan_id=walk.scan_id,
        revision=len(walk.views),
        method=Method(name="paper"),
        views_used=len(walk.views),
        views_rejected=[],
    )
    picture = draw_overlay(busiest_view(walk), document)
    size = (7.2, 7.2 * picture.shape[0] / picture.shape[1])
    figure = plt.figure(figsize=size, layout="none")
    ax = figure.add_axes((0, 0, 1, 1))
    ax.imshow(picture)
    ax.axis("off")
    return figure


def draw_methods(walk: Walk) -> plt.Figure:
    """Figure 7: what the three ways of joining make of the same gaps."""
    centre = greatest_difference(walk)
    figure, axes = plt.subplots(1, 3, figsize=(11, 4.6), sharex=True, sharey=True)
    for ax, (name, graph) in zip(axes, walk.results.items(), strict=True):
        if walk.truth is not None:
            lines = edge_lines(walk, walk.truth)
            ax.add_collection(LineCollection(lines, colors="#D0D0D0", lw=7, capstyle="round"))
        predicted = graph.occluded[graph.edges].any(axis=1)
        observed = LineCollection(edge_lines(walk, graph, ~predicted), colors=[BLUE], lw=1.8)
        ax.add_collection(observed)
        hidden = LineCollection(edge_lines(walk, graph, predicted), colors=[VERMILLION], lw=2.6)
        ax.add_collection(hidden)
        ax.set(title=name, aspect="equal", xlabel="base (m)")
        ax.set(xlim=centre[walk.shown[0]] + np.array([-0.3, 0.3]))
        ax.set(ylim=centre[walk.shown[1]] + np.array([-0.3, 0.3]))
    axes[0].set_ylabel("base (m)")
    for color, label in ((BLUE, "observed"), (VERMILLION, "predicted"), ("#D0D0D0", "truth")):
        axes[2].plot([], [], color=color, lw=3, label=label)
    figure.legend(*axes[2].get_legend_handles_labels(), ncols=3, loc="outside lower center")
    return figure


FIGURES = {
    "1-masks": draw_masks,
    "2-cluster": draw_cluster,
    "3-likelihood": draw_likelihood,
    "4-initial": draw_initial,
    "5-search": draw_search,
    "6-result": draw_result,
    "7-methods": draw_methods,
}


def png_of(figure: plt.Figure) -> bytes:
    """Return a PNG of at most MAX_BYTES, of as many of 256 colours as fit, ours among them."""
    buffer = io.BytesIO()
    figure.savefig(buffer, dpi=130)
    plt.close(figure)
    picture = Image.open(buffer).convert("RGB")
    ours = [round(255 * v) for color in (*CYCLE, "w") for v in mpl.colors.to_rgb(color)]
    for count in (256, 128, 64, 32):
        found = picture.quantize(count - len(ours) // 3).getpalette()[: 3 * count - len(ours)]
        palette = Image.new("P", (1, 1))
        palette.putpalette(ours + found)
        packed = io.BytesIO()
        reduced = picture.quantize(palette=palette, dither=Image.Dither.NONE)
        reduced.save(packed, "png", optimize=True)
        if packed.tell() <= MAX_BYTES:
            return packed.getvalue()
    raise SystemExit(f"a figure takes more than {MAX_BYTES} bytes; draw it smaller")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "recording", nargs="?", type=Path, default=ROOT / "recordings" / "demo_apple.mcap"
    )
    parser.add_argument("--output", type=Path, default=ROOT / "docs" / "images" / "method")
    arguments = parser.parse_args()
    mpl.use("agg")
    plt.rcParams.update({"font.size": 12, "figure.constrained_layout.use": True})
    arguments.output.mkdir(parents=True, exist_ok=True)
    walk = walk_through(arguments.recording)
    for name, draw in FIGURES.items():
        target = arguments.output / f"{name}.png"
        target.write_bytes(png_of(draw(walk)))
        print(f"{target}: {target.stat().st_size // 1000} kB")


if __name__ == "__main__":
    main()
