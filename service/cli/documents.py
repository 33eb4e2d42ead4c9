"""Skeleton documents that the command line is given."""

from pathlib import Path

from canopy_skel.document import SkeletonDocument, from_json
from canopy_skel.errors import DocumentError
from canopy_skel.recording import read_recording


def read_document(path: Path) -> SkeletonDocument:
    """Return the skeleton document of a file.

    Raises:
        DocumentError: the file cannot be read, or holds something else.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise DocumentError(f"{path}: cannot be read ({error.strerror}); check the path") from error
    return from_json(data, str(path))


def read_truth(path: Path) -> SkeletonDocument:
    """Return the true skeleton in a JSON file, or the one attached to a recording.

    Raises:
        DocumentError: nothing readable is there.
    """
    if path.suffix != ".mcap":
        return read_document(path)
    data = read_recording(path).ground_truth
    if data is None:
        raise DocumentError(
            f"{path}: no ground_truth_skeleton.json is attached; give the true skeleton's JSON"
        )
    return from_json(data, f"{path}: ground_truth_skeleton.json")
