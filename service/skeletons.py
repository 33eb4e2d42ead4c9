"""What live scans and replays share, so that both give the same bytes."""

from collections.abc import Callable, Iterable
from functools import partial
from importlib.metadata import version

from canopy_skel.document import (
    Method,
    MovedView,
    RejectedView,
    SkeletonDocument,
    build_document,
)
from canopy_skel.pipeline import Extraction, Skeletonizer
from canopy_skel.segment import Segmenter
from service.segmenters import make_segmenter

# Those a live scan may choose; `service.segmenters` has all, and those with weights of the user's.
SEGMENTERS: dict[str, Callable[[], Segmenter]] = {
    name: partial(make_segmenter, name) for name in ("recorded", "unet")
}
SOFTWARE = f"canopy-skel {version('canopy-skel')}"


def document_of(
    skeletonizer: Skeletonizer,
    extraction: Extraction,
    *,
    scan_id: str,
    rejected: Iterable[RejectedView],
) -> SkeletonDocument:
    """Return the document of a skeleton; its revision is the number of views in it."""
    config, used = skeletonizer.config, len(skeletonizer.views)
    return build_document(
        extraction.graph,
        scan_id=scan_id,
        revision=used,
        method=Method(
            name=config.name,
            voxel_size_m=config.likelihood.voxel_size_m,
            config_sha256=config.sha256(),
            software=SOFTWARE,
        ),
        views_used=used,
        views_rejected=sorted(rejected, key=lambda view: view.index),
        views_moved=[
            MovedView(index=skeletonizer.views[one.view], by_m=one.before_m)
            for one in extraction.corrections
            if one.brought_back
        ],
        views_alone=[skeletonizer.views[one.view] for one in extraction.lone_views],
        preview=extraction.preview,
    )
