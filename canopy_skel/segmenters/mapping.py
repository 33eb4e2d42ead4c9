"""Masks and, beside them, what a network says of every pixel."""

from collections.abc import Sequence
from typing import Protocol, runtime_checkable

from canopy_skel.frame import Float32Array, View
from canopy_skel.segment import BranchMask, Segmenter
from canopy_skel.segmenters.unet.portable import PortableNetwork


@runtime_checkable
class MappingSegmenter(Protocol):
    """A segmenter that has maps as well."""

    def segment_and_map(self, view: View) -> tuple[Sequence[BranchMask], Float32Array]:
        """Return what `segment` returns, and the maps (8, h, w) of the network."""
        ...


class WithMaps:
    """Any segmenter, with the maps of the built-in network where it has none of its own."""

    def __init__(self, segmenter: Segmenter) -> None:
        """The network is read when it is first needed."""
        self._segmenter = segmenter
        self._network: PortableNetwork | None = None

    def segment_and_map(self, view: View) -> tuple[Sequence[BranchMask], Float32Array]:
        """Return masks and maps of a view.

        Raises:
            ViewError: as `Segmenter.segment`.
        """
        if isinstance(self._segmenter, MappingSegmenter):
            return self._segmenter.segment_and_map(view)
        masks = self._segmenter.segment(view)
        if self._network is None:
            self._network = PortableNetwork()
        return masks, self._network.maps(view.color_rgb)
