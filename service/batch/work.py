"""One recording of a batch replayed, in whatever process."""

import json
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from hashlib import file_digest, sha256
from pathlib import Path
from time import perf_counter

from canopy_skel.errors import CanopyError, RecordingError, UsageError
from service.batch.recordings import Found
from service.batch.rows import Row
from service.outputs import remove_parts, require_writable
from service.replay import ReplayRequest, ReplayResult, file_names, replay
from service.sources import sources_sha256


@dataclass(frozen=True, kw_only=True, slots=True)
class Task:
    """A recording to replay.

    output: the folder of the batch. key: of the request. known: its row, if it had one that would
    be good if the content of the recording had not changed.
    """

    found: Found
    output: Path
    request: ReplayRequest
    key: str
    known: Row | None

    @property
    def name(self) -> str:
        """The name of its row."""
        return self.found.name.as_posix()

    @property
    def folder(self) -> Path:
        """Where its results go."""
        return self.output / self.found.name.parent

    def failed(self, error: str) -> Row:
        """Return the row of a recording that came to nothing."""
        return Row(recording=self.name, key=self.key, error=error)

    def remove_parts(self) -> None:
        """Remove what a process that died has left half written."""
        remove_parts(self.folder, file_names(self.found.path.stem, self.request.formats))


def key_of(request: ReplayRequest) -> str:
    """Return the hash of all settings, and of the code and data that a replay with them runs.

    Raises:
        UsageError: the weights cannot be read.
    """
    settings = {
        "config": request.config.sha256(),
        "segmenter": request.segmenter,
        "weights": list(_weights_sha256(request.weights)),
        "formats": sorted(request.formats),
        "topics": None if request.topics is None else asdict(request.topics),
        "sources": sources_sha256(__name__, request.segmenter, request.config.name),
    }
    return sha256(json.dumps(settings, sort_keys=True).encode()).hexdigest()


def _weights_sha256(weights: Path | None) -> Iterator[str]:
    if weights is None:
        return
    for path in (weights, weights.with_suffix(".json")):
        try:
            yield sha256(path.read_bytes()).hexdigest()
        except OSError as error:
            raise UsageError(
                f"{path}: cannot be read ({error.strerror}); check --weights"
            ) from error


def row_of(task: Task) -> Row:
    """Replay a recording; what goes wrong becomes a row with the error."""
    start = perf_counter()
    try:
        return _row(task, start)
    except CanopyError as error:
        row = task.failed(str(error))
    except Exception as error:  # Whatever it is, it must not cost the other recordings.
        row = task.failed(
            f"{task.found.path}: failed for a reason not foreseen ({error!r}); `canopy replay` of"
            " it shows where"
        )
    return replace(row, seconds=_seconds_since(start))


def _row(task: Task, start: float) -> Row:
    if key_of(task.request) != task.key:
        raise UsageError(
            "software or weights are not those of where the batch was started; install the same"
            " everywhere"
        )
    content, known = _content(task), task.known
    if known is not None and known.sha256 == content.sha256:
        return replace(known, size_bytes=content.size_bytes, modified_ns=content.modified_ns)
    require_writable(task.folder)
    result = replay(task.found.path, task.folder, task.request, lambda done, total: None)
    return replace(_with_result(content, result), seconds=_seconds_since(start))


def _seconds_since(start: float) -> float:
    return round(perf_counter() - start, 3)


def _content(task: Task) -> Row:
    """Return a row that says which recording it is.

    Raises:
        RecordingError: it cannot be read.
    """
    path = task.found.path
    try:
        # The time first: what is written to it from now on will show.
        facts = path.stat()
        with path.open("rb") as stream:
            digest = file_digest(stream, "sha256").hexdigest()
    except OSError as error:
        raise RecordingError(
            f"{path}: cannot be read ({error.strerror}); check the file"
        ) from error
    return Row(
        recording=task.name,
        key=task.key,
        size_bytes=facts.st_size,
        modified_ns=facts.st_mtime_ns,
        sha256=digest,
    )


def _with_result(row: Row, result: ReplayResult) -> Row:
    document = result.document
    rejected = (f"view {view.index} left out: {view.reason}" for view in document.views_rejected)
    return replace(
        row,
        files=tuple(file.name for file in result.files),
        views_used=document.views_used,
        views_rejected=len(document.views_rejected),
        branches=len(document.branches),
        components=document.components,
        length_m=round(sum(branch.length for branch in document.branches), 3),
        warnings=(*result.warnings, *rejected),
    )
