"""What was asked of the method's speed, what was measured, and whether that meets it."""

from parts.common import table

LITERAL = "Algorithm 1 / literal"
SINGLE = "Algorithm 1 / one scipy Dijkstra"
# what, at 5 mm if nothing else is said; the fact; the bound; its unit
AT_LEAST = (
    ("map update over numpy per bounding box", ("map update", 5), 50, "x"),
    ("least squares over make_lsq_spline", ("least squares", 5), 20, "x"),
    ("consolidation and forest over kd-tree and csgraph", ("consolidation and forest", 5), 10, "x"),
    ("Algorithm 1 over its literal form (extrapolated)", (LITERAL, 5), 300, "x"),
    ("repair after a view over a new search, equal bits", ("repair", 5, 45), 10, "x"),
    ("one scipy Dijkstra on a prebuilt graph over Algorithm 1", (SINGLE, 5), 0.5, "x"),
)
AT_MOST = (
    ("update after a view, clusters counted", ("update", 5, 45), 150, "ms"),
    ("the same at 10 mm", ("update", 10, 45), 50, "ms"),
    ("the same at 5 mm with many fragments", ("update", 5, 300), 700, "ms"),
    ("preview with many fragments", ("preview", 5, 300), 100, "ms"),
    ("memory of the whole process", "memory", 600, "MB"),
    ("first result from nothing compiled, `canopy`, by the clock", ("none yet", "canopy"), 15, "s"),
    ("first result from nothing compiled, `paper`, by the clock", ("none yet", "paper"), 15, "s"),
    ("first result with kernels on disk, `canopy`, by the clock", ("on disk", "canopy"), 3, "s"),
    ("first result with kernels on disk, `paper`, by the clock", ("on disk", "paper"), 3, "s"),
)


def report(facts):
    rows = []
    for asked, sign, holds in (
        (AT_LEAST, ">=", lambda value, bound: value >= bound),
        (AT_MOST, "<", lambda value, bound: value < bound),
    ):
        for what, name, bound, unit in asked:
            if name in facts:
                met = "yes" if holds(facts[name], bound) else "**no**"
                rows.append((what, f"{sign} {bound} {unit}", f"{facts[name]:.3g} {unit}", met))
    return table("Asked, measured, met", ("what", "asked", "measured", "met"), rows)
