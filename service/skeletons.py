"""What live scans and replays share, so that both give the same bytes."""

from collections.abc import Callable, Iterable
from importlib.metadata import version

from canopy_skel.document import Method, RejectedView, SkeletonDocument, build_document
from canopy_skel.pipeline import Extraction, Skeletonizer
from canopy_skel.segment import Segmenter
from canopy_skel.segmenters.recorded import RecordedSegmenter

SEGMENTERS: dict[str, Callable[[], Segmenter]] = {"recorded": RecordedSegmenter}
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
        preview=extraction.preview,
    )
