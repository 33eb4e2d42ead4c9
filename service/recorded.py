"""The views of a recording as it lies on disk now, to be sent: it may grow, move or be replaced."""

from pathlib import Path

from canopy_skel.errors import RecordingError
from canopy_skel.messages import Message
from canopy_skel.recording import Recording, messages_of_view, read_recording

_FileId = tuple[int, int]


class RecordedViews:
    """Reads views one by one; a recording is looked through anew only if need be.

    A scan that goes on puts another file in the place of its recording: where a view was in the
    one says nothing of the other. So what was looked through counts for that very file only.
    """

    def __init__(self) -> None:
        self._known: tuple[_FileId | None, Recording] | None = None

    def forget(self) -> None:
        """Look through the next recording anew."""
        self._known = None

    def look_through(self, path: Path) -> Recording:
        """Return what is in a recording now.

        Raises:
            RecordingError: it cannot be read.
        """
        file_id = _file_id(path)
        recording = read_recording(path)
        self._known = (file_id, recording)
        return recording

    def messages(self, path: Path, index: int) -> tuple[Message, ...]:
        """Return the messages of a view as they were recorded.

        Raises:
            RecordingError: it cannot be read, or was replaced meanwhile; try again.
            UsageError: it has no such view.
        """
        file_id = _file_id(path)
        recording = self._recording(path, file_id, index)
        messages = messages_of_view(recording, index)
        if _file_id(path) != file_id:
            raise RecordingError(f"{path}: was moved or replaced while it was read; try again")
        return messages

    def _recording(self, path: Path, file_id: _FileId | None, index: int) -> Recording:
        known = self._known
        if known is not None:
            known_id, recording = known
            same = (known_id, recording.path) == (file_id, path)
            if same and index in {group.index for group in recording.groups}:
                return recording
        return self.look_through(path)


def _file_id(path: Path) -> _FileId | None:
    """Return what tells a file from others of its name; None where there is none."""
    try:
        found = path.stat()
    except OSError:
        return None
    return found.st_dev, found.st_ino
