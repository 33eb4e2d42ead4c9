"""CSV of cylinders in the columns of TreeQSM (Raumonen et al. 2013): one per edge, one-based.

`parent` is the cylinder this one grows from and `extension` the next one of the same branch, by
row; 0 where there is none. `branch` is the branch's id + 1, `BranchOrder` 0 for the trunk.
"""

import csv
import io
from itertools import pairwise

import numpy as np

from canopy_skel.document import SkeletonDocument

_COLUMNS = (
    *("radius", "length", "start_x", "start_y", "start_z", "axis_x", "axis_y", "axis_z"),
    *("parent", "extension", "branch", "BranchOrder", "PositionInBranch"),
    *("confidence", "occluded"),
)


def write_cylinders(document: SkeletonDocument) -> bytes:
    """Return one row per edge, in metres.

    radius: mean of both ends, of the outer end alone where a side branch leaves its parent.
    confidence: the lower one of both ends. occluded: 1 if either end is. A cylinder without
    length points up.
    """
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    table.writerow(_COLUMNS)
    row_ending_at: dict[int, int] = {}
    row = 0
    for branch in document.branches:
        last = row + len(branch.vertices) - 1
        for place, (a, b) in enumerate(pairwise(branch.vertices), start=1):
            row += 1
            leaves_parent = place == 1 and branch.parent is not None
            start_radius = document.radius[b if leaves_parent else a]
            table.writerow(
                (
                    f"{(start_radius + document.radius[b]) / 2:.5f}",
                    *_placed(document.position[a], document.position[b]),
                    row_ending_at.get(a, 0),
                    row + 1 if row < last else 0,
                    branch.id + 1,
                    branch.order,
                    place,
                    f"{min(document.confidence[a], document.confidence[b]):.4f}",
                    int(document.occluded[a] or document.occluded[b]),
                )
            )
            row_ending_at[b] = row
    return text.getvalue().encode()


def _placed(start: np.ndarray, end: np.ndarray) -> list[str]:
    """Return length, start and axis as text."""
    length_m = float(np.linalg.norm(end - start))
    axis = (end - start) / length_m if length_m > 0 else np.array([0.0, 0.0, 1.0])
    return [
        f"{length_m:.5f}",
        *(f"{x:.5f}" for x in start.tolist()),
        *(f"{x:.6f}" for x in (axis + 0.0).tolist()),
    ]
