"""A skeleton that grows while its views arrive: what the worker does, without bus and clock."""

from collections.abc import Callable
from contextlib import AbstractContextManager

import numpy as np

from canopy_skel.document import RejectedView, to_json
from canopy_skel.errors import CanopyError, UsageError
from canopy_skel.frame import Intrinsics, View
from canopy_skel.pipeline import MethodConfig, MethodName, Skeletonizer
from canopy_skel.recording import view_from_messages
from drivers.stereo import with_depth
from service.doctor import available_memory_bytes
from service.envelope import ViewEnvelope
from service.skeletons import SEGMENTERS, document_of

Stage = Callable[[str], AbstractContextManager[None]]


class LiveSkeleton:
    """The views of one scan so far, and the document they give.

    The document has the bytes that `canopy replay` gives for a recording of these views, whatever
    order they came in and however often.

    Raises:
        UsageError: the segmenter is not known.
    """

    def __init__(self, scan_id: str, config: MethodConfig, segmenter: str, stage: Stage) -> None:
        """`stage(name)` is entered around each step of the method."""
        if segmenter not in SEGMENTERS:
            known = ", ".join(SEGMENTERS)
            raise UsageError(f"unknown segmenter {segmenter!r}: choose one of {known}")
        self._scan_id, self._segmenter, self._stage = scan_id, segmenter, stage
        self._rejected: dict[int, RejectedView] = {}
        self._skeletonizer = Skeletonizer(
            SEGMENTERS[segmenter](),
            config,
            stage=stage,
            memory_limit_bytes=available_memory_bytes() // 2,
        )

    @property
    def views(self) -> tuple[int, ...]:
        """Indices of the views that are in, ascending."""
        return self._skeletonizer.views

    @property
    def rejected(self) -> tuple[int, ...]:
        """Indices of the views that could not be used, ascending."""
        return tuple(sorted(self._rejected))

    def fits(self, envelope: ViewEnvelope) -> bool:
        """Whether an envelope is of this scan, made by the same method and segmenter."""
        here = (self._scan_id, self._segmenter, self._skeletonizer.config)
        return here == (envelope.scan_id, envelope.segmenter, envelope.config)

    def add(self, envelope: ViewEnvelope) -> None:
        """Take in a view, or remember why it cannot be used; a known one changes nothing."""
        index = envelope.view
        if index in self._rejected or index in self.views:
            return
        try:
            with self._stage("read"):
                view = view_from_messages(envelope.messages)
            with self._stage("stereo"):
                view = with_depth(view)
            self._skeletonizer.add_view(view)
        except CanopyError as error:
            self.reject(index, str(error))

    def reject(self, index: int, reason: str) -> None:
        """Remember a view as unusable."""
        self._rejected[index] = RejectedView(index=index, reason=reason)

    def document(self, *, preview: bool = False) -> bytes | None:
        """Return the skeleton document (JSON) of the views so far; None without a usable view.

        A preview says so in the document, takes less time and joins nearly the same.
        """
        if not self.views:
            return None
        maker = self._skeletonizer
        document = document_of(
            maker,
            maker.preview() if preview else maker.skeleton(),
            scan_id=self._scan_id,
            rejected=self._rejected.values(),
        )
        return to_json(document)


def warm_up(stage: Stage) -> None:
    """Load (or compile) the kernels of all methods by small skeletons: two sticks, a gap between.

    The sticks are long enough for a pose to be told by them, and thick enough to have bark. `mst`
    and `ftsem` need no kernel that `paper` does not.
    """
    size = (60, 320)
    instances = np.zeros(size, dtype=np.uint16)
    instances[25:35, 10:140], instances[25:35, 160:310] = 1, 2
    view = View(
        index=0,
        stamp_ns=0,
        color_rgb=np.zeros((*size, 3), dtype=np.uint8),
        intrinsics=Intrinsics(
            fx_px=300, fy_px=300, cx_px=160, cy_px=30, width_px=size[1], height_px=size[0]
        ),
        base_from_camera=np.eye(4),
        depth_m=np.ones(size, dtype=np.float32),
        instances=instances,
        scores=(0.9, 0.9),
    )
    names: tuple[MethodName, ...] = ("paper", "canopy")
    for name in names:
        maker = Skeletonizer(SEGMENTERS["recorded"](), MethodConfig(name=name), stage=stage)
        maker.add_view(view)
        maker.preview()
        to_json(document_of(maker, maker.skeleton(), scan_id="warm-up", rejected=()))
