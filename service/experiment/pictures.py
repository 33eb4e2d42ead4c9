"""All pictures of an experiment by file name, with their titles."""

from collections.abc import Sequence

from canopy_skel.errors import CanopyError
from service.experiment.examples import example
from service.experiment.figures import over_degradation, over_foliage
from service.experiment.report import degradations
from service.experiment.rows import Row
from service.experiment.run import Experiment
from service.experiment.segmenters import segmenter_named
from service.experiment.table import Rows

EXAMPLE_FOLIAGE = 3


def draw_all(plan: Experiment, rows: Sequence[Row]) -> dict[str, tuple[str, bytes]]:
    """Return title and PNG by file name; nothing where there are no rows with figures."""
    some = Rows.of(rows)
    if not some.rows:
        return {}
    first = plan.segmenters[0]
    pictures = {
        "over_foliage.png": (
            f"Precision, recall and OSR over foliage density, masks: {first}",
            over_foliage(some.where(segmenter=first), plan.methods),
        )
    }
    if len(degradations(plan.segmenters)) > 1:
        pictures["over_degradation.png"] = (
            "Worse masks, FD3 and FD4",
            over_degradation(some, plan.methods, plan.segmenters),
        )
    for species in some.species:
        trees = [tree for tree in plan.orchard.trees if tree.species == species]
        tree = min(trees, key=lambda tree: (abs(tree.foliage - EXAMPLE_FOLIAGE), tree.topology))
        try:
            data = example(plan.folder, tree, plan.methods, segmenter_named(first))
        except CanopyError:
            continue  # Its rows say so already.
        title = f"{tree.name}: blue right and observed, green right and predicted, red wrong"
        pictures[f"example_{species}.png"] = (title, data)
    return pictures
