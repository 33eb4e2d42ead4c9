"""Start a scan on a running service and follow it to its end: what `canopy scan` does."""

import json
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from types import TracebackType
from typing import Any, Self
from uuid import uuid4

import httpx2

from canopy_skel.errors import CanopyError
from service.rig import ScanState, ScanStatus

_SILENCE_S = 45.0  # the service sends a comment at least every 15 s
_PAUSE_S = 0.3
_LONG_POLL_S = 10


class UnreachableServiceError(CanopyError):
    """No answer from the service."""


class RefusedError(CanopyError):
    """The service answered with a problem; the message is its title and detail.

    status, code: of the answer. more: further members, such as the refused `waypoints`.
    """

    def __init__(self, status: int, code: str, message: str, more: Mapping[str, Any]) -> None:
        super().__init__(message)
        self.status = status
        self.code = code
        self.more = more


@dataclass(frozen=True, kw_only=True, slots=True)
class ScanEvent:
    """Something that happened in a scan, and where the scan was then."""

    kind: str
    status: ScanStatus
    fields: Mapping[str, Any]


@dataclass(frozen=True, kw_only=True, slots=True)
class ScanResult:
    """How a scan ended. skeleton: the document of all its views, or the newest there is."""

    status: ScanStatus
    skeleton: bytes | None
    complete: bool


def scan(
    url: str,
    body: Mapping[str, Any],
    progress: Callable[[ScanEvent], None],
    *,
    key: str | None = None,
    patience_s: float = 10.0,
    skeleton_timeout_s: float = 120.0,
) -> ScanResult:
    """Start a scan, tell `progress` of every event, return how it ended.

    Args:
        url: of the service, such as http://127.0.0.1:8000.
        body: see POST /v1/scans.
        progress: called for every event, in order.
        key: of the service, if it has one.
        patience_s: how long the service may be unreachable before this gives up.
        skeleton_timeout_s: how long the worker may need after the last view.

    Raises:
        RefusedError: the service refused; nothing moved.
        UnreachableServiceError: the service did not answer; the scan may go on without us.
    """
    with ScanClient(url, key=key, patience_s=patience_s) as client:
        scan_id = client.start(body, key=str(uuid4()))
        for event in client.follow(scan_id):
            progress(event)
        status = client.status(scan_id)
        skeleton, complete = client.skeleton(scan_id, status.views_done, skeleton_timeout_s)
    return ScanResult(status=status, skeleton=skeleton, complete=complete)


def fetch(url: str, path: str) -> bytes:
    """Return what lies at a path of the service.

    Raises:
        RefusedError, UnreachableServiceError: as `scan`.
    """
    with ScanClient(url) as client:
        return client.fetch(path)


class ScanClient:
    """Talks to one service; requests that may be repeated are, for `patience_s`."""

    def __init__(self, url: str, *, key: str | None = None, patience_s: float = 10.0) -> None:
        self._url = url
        self._patience_s = patience_s
        headers = {} if key is None else {"Authorization": f"Bearer {key}"}
        self._http = httpx2.Client(base_url=url, timeout=_SILENCE_S, headers=headers)

    def __enter__(self) -> Self:
        """Return itself; connections are made when they are needed."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        """Close the connections."""
        self._http.close()

    def start(self, body: Mapping[str, Any], key: str) -> str:
        """Start a scan and return its id; with the same key it starts once, however often asked.

        Raises:
            RefusedError, UnreachableServiceError: see `scan`.
        """
        answer = self._ask("POST", "/v1/scans", json=body, headers={"Idempotency-Key": key})
        return str(answer.json()["scan_id"])

    def status(self, scan_id: str) -> ScanStatus:
        """Return where a scan is. Raises as `start`."""
        return _status(self._ask("GET", f"/v1/scans/{scan_id}").json())

    def fetch(self, path: str) -> bytes:
        """Return what lies at a path."""
        return self._ask("GET", path).content

    def cancel(self, scan_id: str) -> ScanStatus:
        """Stop the arm and end the scan. Raises as `start`."""
        return _status(self._ask("POST", f"/v1/scans/{scan_id}:cancel").json())

    def follow(self, scan_id: str) -> Iterator[ScanEvent]:
        """Yield every event of a scan from its first to its end, also across lost connections.

        Raises:
            RefusedError: there is no such scan.
            UnreachableServiceError: the service was silent for too long.
        """
        seen, heard_s = 0, time.perf_counter()
        while True:
            try:
                for number, event in self._stream(scan_id, seen):
                    if event is None:
                        return
                    seen, heard_s = number, time.perf_counter()
                    yield event
                    heard_s = time.perf_counter()
            except httpx2.TransportError as error:
                self._lose_patience(heard_s, error)
            time.sleep(_PAUSE_S)

    def skeleton(self, scan_id: str, views: int, timeout_s: float) -> tuple[bytes | None, bool]:
        """Return the skeleton of `views` views, and whether all are in; waits up to `timeout_s`.

        Raises as `start`.
        """
        path = f"/v1/scans/{scan_id}/skeleton.json"
        until_s = time.perf_counter() + timeout_s
        newest, etag = None, ""
        while views and (left_s := until_s - time.perf_counter()) > 0:
            wait = f"wait={max(1, min(_LONG_POLL_S, int(left_s)))}"
            try:
                answer = self._ask("GET", path, headers={"Prefer": wait, "If-None-Match": etag})
            except RefusedError as error:
                if error.code != "skeleton_pending":
                    raise
                continue
            if answer.status_code != httpx2.codes.NOT_MODIFIED:
                newest, etag = answer.content, answer.headers["ETag"]
                told = json.loads(newest)["views"]
                if told["used"] + len(told["rejected"]) >= views:
                    return newest, True
        return newest, views == 0

    def _stream(self, scan_id: str, seen: int) -> Iterator[tuple[int, ScanEvent | None]]:
        """Yield number and event of what is new; None for the event that says the scan is over."""
        headers = {"Last-Event-ID": str(seen)}
        path = f"/v1/scans/{scan_id}/events"
        with self._http.stream("GET", path, headers=headers) as stream:
            if stream.is_error:
                stream.read()
            _raise_if_refused(stream)
            for fields in _sse(stream.iter_lines()):
                if fields["event"] == "end":
                    yield seen, None
                    return
                data = json.loads(fields["data"])
                yield (
                    int(fields["id"]),
                    ScanEvent(kind=fields["event"], status=_status(data), fields=data["fields"]),
                )

    def _ask(self, method: str, path: str, **options: Any) -> httpx2.Response:  # noqa: ANN401
        asked_s = time.perf_counter()
        while True:
            try:
                answer = self._http.request(method, path, **options)
            except httpx2.TransportError as error:
                self._lose_patience(asked_s, error)
                time.sleep(_PAUSE_S)
                continue
            _raise_if_refused(answer)
            return answer

    def _lose_patience(self, since_s: float, error: Exception) -> None:
        if time.perf_counter() - since_s > self._patience_s:
            raise UnreachableServiceError(
                f"{self._url}: no answer ({error}); is `canopy serve` running there?"
            ) from error


def _raise_if_refused(answer: httpx2.Response) -> None:
    if not answer.is_error:
        return
    try:
        problem: dict[str, Any] = answer.json()
        message = f"{problem.pop('title')}: {problem.pop('detail')}"
        code = str(problem.pop("code"))
    except (ValueError, KeyError) as error:
        raise RefusedError(
            answer.status_code, "no_problem", f"{answer.url}: status {answer.status_code}", {}
        ) from error
    raise RefusedError(answer.status_code, code, message, problem)


def _sse(lines: Iterator[str]) -> Iterator[dict[str, str]]:
    """Yield the fields of each server-sent event; comments are left out."""
    fields: dict[str, str] = {}
    for line in lines:
        name, _, value = line.partition(":")
        if name:
            fields[name] = value.removeprefix(" ")
        elif not line and fields:
            yield fields
            fields = {}


def _status(fields: Mapping[str, Any]) -> ScanStatus:
    known = {name: fields[name] for name in ScanStatus.__slots__}
    return ScanStatus(**known | {"state": ScanState(fields["state"])})
