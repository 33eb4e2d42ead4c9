"""Masks that came with the recording, from anybody's network or from a simulation."""

from collections.abc import Sequence

from scipy.ndimage import find_objects

from canopy_skel.errors import ViewError
from canopy_skel.frame import View
from canopy_skel.segment import BranchMask


class RecordedSegmenter:
    """Hands on the instances recorded on `/camera/branches/*`."""

    def segment(self, view: View) -> Sequence[BranchMask]:
        """Return the recorded instances that have pixels and a score above 0.

        Raises:
            ViewError: instances or scores are missing, or do not belong together.
        """
        if view.instances is None or view.scores is None:
            raise ViewError(
                f"view {view.index}: no recorded branch instances with scores; record"
                " /camera/branches/instances and /camera/branches/scores, or choose a segmenter"
                " that looks at the picture"
            )
        highest = int(view.instances.max(initial=0))
        if highest > len(view.scores):
            raise ViewError(
                f"view {view.index}: /camera/branches/instances holds instance {highest} but"
                f" /camera/branches/scores has {len(view.scores)} scores; write one score for each"
            )
        masks = []
        for number, box in enumerate(find_objects(view.instances), start=1):
            if box is not None and view.scores[number - 1] > 0.0:
                masks.append(
                    BranchMask(
                        instance=number,
                        left_px=box[1].start,
                        top_px=box[0].start,
                        mask=view.instances[box] == number,
                        confidence=view.scores[number - 1],
                    )
                )
        return masks
