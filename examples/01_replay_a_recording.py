"""A recording becomes a skeleton document: what `canopy replay` does, in a few lines."""

from pathlib import Path

from canopy_skel.document import RejectedView
from canopy_skel.exports import FORMATS
from canopy_skel.pipeline import MethodConfig, Skeletonizer
from canopy_skel.recording import read_recording
from canopy_skel.segmenters.recorded import RecordedSegmenter
from service.skeletons import document_of

RECORDING = Path(__file__).parents[1] / "recordings/demo_apple.mcap"
OUT = Path("out")


def main() -> None:
    """Read the views one by one; the skeleton grows with each."""
    recording = read_recording(RECORDING)
    skeletonizer = Skeletonizer(RecordedSegmenter(), MethodConfig())
    rejected = []
    for view in recording.views():
        if isinstance(view, RejectedView):
            rejected.append(view)
        else:
            pieces = skeletonizer.add_view(view)
            print(f"view {view.index} shows {pieces} pieces of wood")

    document = document_of(
        skeletonizer, skeletonizer.skeleton(), scan_id=recording.scan_id, rejected=rejected
    )
    print(f"{len(document.branches)} branches; the longest:")
    for branch in sorted(document.branches, key=lambda branch: -branch.length)[:4]:
        predicted = document.occluded[list(branch.vertices)].mean()
        print(
            f"  {branch.kind} {branch.id}: {branch.length:.2f} m, radius"
            f" {1000 * branch.mean_radius:.0f} mm, confidence {branch.confidence:.2f},"
            f" {predicted:.0%} predicted"
        )

    OUT.mkdir(exist_ok=True)
    for ending in ("json", "glb"):
        file = OUT / f"{RECORDING.stem}.skeleton.{ending}"
        file.write_bytes(FORMATS[ending](document))
        print(file)


if __name__ == "__main__":
    main()
