"""What live scans and replays share, so that both give the same bytes."""

from collections.abc import Callable, Iterable
from importlib.metadata import version

from canopy_skel.document import Method, RejectedView, SkeletonDocument, build_document
from canopy_skel.pipeline import Extraction, Skeletonizer
from canopy_skel.segment import Segmenter
from canopy_skel.segmenters.recorded import RecordedSegmenter


def _unet() -> Segmenter:
    """Return the learned segmenter with the built-in weights."""
    # Imported here: torch takes seconds to load, and only this segmenter needs it.
    from canopy_skel.segmenters.unet.segmenter import UNetSegmenter
    from canopy_skel.segmenters.unet.weights import load

    return UNetSegmenter(load())


SEGMENTERS: dict[str, Callable[[], Segmenter]] = {"recorded": RecordedSegmenter, "unet": _unet}
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
    )
