"""The next view is segmented on another core while the one before is fused."""

from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Self

from canopy_skel.frame import Float32Array, View
from canopy_skel.segment import BranchMask, Segmenter
from canopy_skel.segmenters.mapping import WithMaps

Seen = tuple[Sequence[BranchMask], Float32Array | None]


class Ahead:
    """A segmenter that begins with a view as soon as it is expected; to be closed by `with`."""

    def __init__(self, segmenter: Segmenter, *, maps: bool) -> None:
        """maps: whether the network's maps will be wanted, too."""
        self._segmenter, self._with_maps = segmenter, WithMaps(segmenter) if maps else None
        self._worker = ThreadPoolExecutor(1, "segmenter")
        self._expected: dict[int, Future[Seen]] = {}

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._worker.shutdown(cancel_futures=True)

    def expect(self, view: View) -> None:
        """Begin with a view that will be asked for."""
        self._expected[view.index] = self._worker.submit(self._look, view)

    def segment(self, view: View) -> Sequence[BranchMask]:
        """Return the masks of a view.

        Raises:
            ViewError: the view lacks what the segmenter needs.
        """
        return self._seen(view)[0]

    def segment_and_map(self, view: View) -> tuple[Sequence[BranchMask], Float32Array]:
        """Return masks and maps of a view, where maps are wanted.

        Raises: as `segment`.
        """
        masks, maps = self._seen(view)
        if maps is None:
            raise RuntimeError("maps were not wanted when this began")
        return masks, maps

    def _seen(self, view: View) -> Seen:
        if view.index not in self._expected:
            self.expect(view)
        return self._expected.pop(view.index).result()

    def _look(self, view: View) -> Seen:
        if self._with_maps is None:
            return self._segmenter.segment(view), None
        return self._with_maps.segment_and_map(view)
