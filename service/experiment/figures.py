"""The experiment's curves as pictures: over foliage density, and over worse masks."""

import io
from collections.abc import Sequence

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from service.experiment.published import published
from service.experiment.report import DENSE, HEADS, degradations
from service.experiment.table import Rows

# Okabe & Ito, "Color universal design" (2008), as canopy_skel/exports/palette.py.
COLORS = {"paper": "#0072B2", "mst": "#E69F00", "ftsem": "#009E73", "canopy": "#D55E00"}
OTHER = "#CC79A7"


def over_foliage(rows: Rows, methods: Sequence[str]) -> bytes:
    """Draw precision, recall and OSR over foliage density by species, the paper's dashed."""
    numbers = published()
    species = rows.species
    figure = Figure(figsize=(10, 2.8 * len(species)), layout="constrained")
    axes = figure.subplots(len(species), 3, squeeze=False)
    for line, name in zip(axes, species, strict=True):
        for ax, figure_name in zip(line, HEADS, strict=True):
            for method in methods:
                some = rows.where(species=name, method=method)
                _curve(ax, some, figure_name, method)
                theirs = [numbers.get((name, fd, method, figure_name)) for fd in rows.foliage]
                if None not in theirs:
                    ax.plot(rows.foliage, theirs, "--", color=_color(method), lw=1, alpha=0.7)
            ax.set(title=f"{name}: {HEADS[figure_name]}", xticks=rows.foliage)
            ax.grid(alpha=0.25)
    for ax in axes[-1]:
        ax.set_xlabel("foliage density")
    handles, labels = axes[0][0].get_legend_handles_labels()
    handles.append(Line2D([], [], color="0.4", ls="--", lw=1))
    figure.legend(
        handles, [*labels, "the paper's numbers"], loc="outside lower center", ncols=len(labels) + 1
    )
    return png(figure)


def _curve(ax: Axes, rows: Rows, figure_name: str, method: str) -> None:
    points = [(fd, rows.where(foliage=[fd]).mean(figure_name)) for fd in rows.foliage]
    known = [(fd, mean) for fd, mean in points if mean is not None]
    if known:
        ax.errorbar(
            [fd for fd, _ in known],
            [mean.mean for _, mean in known],
            [mean.error or 0.0 for _, mean in known],
            fmt="o-",
            ms=4,
            capsize=2,
            color=_color(method),
            label=method,
        )


def over_degradation(rows: Rows, methods: Sequence[str], segmenters: Sequence[str]) -> bytes:
    """Draw precision, recall, and precision of what is predicted, over dropped instances."""
    shown = {"precision": "P", "recall": "R", "occ_precision": "precision of what is predicted"}
    figure = Figure(figsize=(10, 3.6), layout="constrained")
    axes = figure.subplots(1, 3)
    dense = rows.where(foliage=DENSE)
    dense = dense if dense.rows else rows
    known = degradations(segmenters)
    for ax, (figure_name, title) in zip(axes, shown.items(), strict=True):
        for method in methods:
            for false in sorted({shares[1] for shares in known.values()}):
                line = sorted((drop, name) for name, (drop, f) in known.items() if f == false)
                means = [
                    (drop, dense.where(method=method, segmenter=name).mean(figure_name))
                    for drop, name in line
                ]
                there = [(drop, mean.mean) for drop, mean in means if mean is not None]
                if there:
                    ax.plot(
                        *zip(*there, strict=True),
                        "o-" if false == 0 else "s--",
                        ms=4,
                        color=_color(method),
                        label=method if false == 0 else f"{method}, {false} % false added",
                    )
        ax.set(title=title, xlabel="instances dropped (%)")
        ax.grid(alpha=0.25)
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=3)
    return png(figure)


def _color(method: str) -> str:
    return COLORS.get(method, OTHER)


def png(figure: Figure, dpi: int = 110) -> bytes:
    """Return a figure as PNG."""
    out = io.BytesIO()
    # Without the library's version in it, the same numbers give the same bytes for longer.
    figure.savefig(out, format="png", dpi=dpi, metadata={"Software": None})
    return out.getvalue()
