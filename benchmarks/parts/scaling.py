"""How the update after a view grows with views, instances, fragments and volume."""

import numpy as np
from parts.common import Engine, clusters_of_views, table
from parts.updates import STAGES, update

VOXEL_M = 0.005


def report(quick, output, kept):
    def median_of(*scene):
        name = "scaling-" + "-".join(f"{number:g}" for number in scene)
        return kept(name, lambda: typical(*scene))

    views = 40 if quick else 200
    curves = {
        "views seen so far": dict(
            enumerate(
                kept(f"scaling-views-{views}", lambda: over_views(views)),
                start=1,
            )
        ),
        "instances per view": {
            n: median_of(45, 12, n) for n in ((10, 25) if quick else (5, 10, 25, 50, 100))
        },
        "fragments": {
            n: median_of(n, 12, 25) for n in ((20, 100) if quick else (20, 50, 100, 200, 350, 500))
        },
        "volume and wood, times": {
            n: median_of(45 * n, 6 * n, 25, 2.0 * n ** (1 / 3), 66.0 * n)
            for n in ((1, 2) if quick else (1, 2, 4, 8, 16))
        },
    }
    if output:
        output.mkdir(parents=True, exist_ok=True)
        draw(curves, output / "bench-scaling.png")
    rows = [
        (name, x, *(float(ms[s]) for s in STAGES), float(sum(ms[s] for s in STAGES)))
        for name, curve in curves.items()
        for x, ms in thinned(curve).items()
    ]
    text = table(
        "Scaling of the update after a view, 5 mm, ms", ("over", "at", *STAGES, "sum"), rows
    )
    return text + ("\n![The same as curves](bench-scaling.png)\n" if output else ""), {}


def over_views(views):
    engine = Engine(VOXEL_M)
    return [update(engine, clusters)[0] for clusters in clusters_of_views(45, views)]


def typical(*scene):
    """The median update of the last third of the views of a scene."""
    engine, times = Engine(VOXEL_M), []
    for clusters in clusters_of_views(*scene):
        times.append(update(engine, clusters)[0])
    last = times[-max(3, len(times) // 3) :]
    return {stage: float(np.median([ms[stage] for ms in last])) for stage in STAGES}


def thinned(curve):
    if len(curve) <= 10:
        return curve
    chosen = [n for n in (1, 5, 10, 20, 40, 70, 100, 150, 200) if n in curve]
    near = {n: [curve[m] for m in range(max(1, n - 2), n + 3) if m in curve] for n in chosen}
    return {n: {s: np.median([ms[s] for ms in group]) for s in STAGES} for n, group in near.items()}


def draw(curves, path):
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    figure, axes = plt.subplots(2, 2, figsize=(11, 7), layout="constrained")
    for ax, (name, curve) in zip(axes.ravel(), curves.items(), strict=True):
        x = list(curve)
        for stage in STAGES:
            ax.plot(x, [curve[n][stage] for n in x], label=stage, lw=1.2)
        ax.plot(x, [sum(curve[n].values()) for n in x], "k", lw=2, label="sum")
        ax.set(xlabel=name, ylabel="ms", ylim=(0, None))
        ax.grid(alpha=0.3)
    axes[0, 0].legend(ncols=3, fontsize=8)
    figure.savefig(path, dpi=110)
