"""Grow a tree, scan it, make its skeleton by two methods, and compare both with the truth."""

from canopy_skel.metrics import score
from canopy_skel.pipeline import MethodConfig, MethodName, Skeletonizer
from canopy_skel.segmenters.recorded import RecordedSegmenter
from mock_hw.orchard.camera import Camera, scaled
from mock_hw.orchard.simulate import Options, prepare, truth, views
from service.skeletons import document_of

METHODS: tuple[MethodName, ...] = ("canopy", "paper")
TREE = Options(species="apple", topology=3, leaf_count=200, camera=scaled(Camera(), 0.4))


def main() -> None:
    """Both methods get the same views. One small simulated scan says nothing of an orchard."""
    scan = prepare(TREE)
    pictures = list(views(scan))
    true = truth(scan)
    print(f"{scan.scan_id}: {len(true.branches)} branches, {len(pictures)} views")

    for name in METHODS:
        skeletonizer = Skeletonizer(RecordedSegmenter(), MethodConfig(name=name))
        for view in pictures:
            skeletonizer.add_view(view)
        document = document_of(
            skeletonizer, skeletonizer.skeleton(), scan_id=scan.scan_id, rejected=()
        )
        scores = score(document, true)
        print(
            f"{name:6}  precision {scores.precision:.3f}  recall {scores.recall:.3f}"
            f"  of hidden wood {scores.recall_hidden:.3f}"
        )


if __name__ == "__main__":
    main()
