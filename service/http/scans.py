"""Routes of scans: start, follow, command, look at what was seen."""

from collections.abc import AsyncIterator
from datetime import UTC, datetime
from hashlib import sha256
from typing import Annotated, Any

from fastapi import APIRouter, Depends, Header, Query, Response
from fastapi.concurrency import run_in_threadpool
from fastapi.responses import JSONResponse
from fastapi.sse import EventSourceResponse, ServerSentEvent

from service.bell import wait_for_ring
from service.catalogue import MOST_NUMBER, EventRecord, ScanRecord
from service.http.access import COMMAND
from service.http.context import Context, Here, KnownScan
from service.http.files import file_response
from service.http.problems import RECORDING_TYPE, Problem
from service.http.requests import ScanBody, scan_spec
from service.pictures import NoPictureError, PictureKind, open_recorded
from service.rig import FINISHED, status_fields

router = APIRouter(prefix="/v1/scans", tags=["scans"])
_LOOK_AGAIN_S = 5.0
# A rig says that a scan has ended before it tells the events that led there, and while the end
# cannot be noted, nor can they.
_LAST_WORDS_S = 0.3
_LAST_WORDS_UNNOTED_S = 5.0


Key = Annotated[str | None, Header(alias="idempotency-key", min_length=1, max_length=255)]


def idempotency_key(idempotency_key: Key = None) -> str:
    """Return the key, or refuse: without one a repeated request would move the arm twice."""
    if idempotency_key is None:
        raise Problem(
            400,
            "idempotency_key_missing",
            "Idempotency-Key missing",
            "send an Idempotency-Key header, a new one (such as a UUID) for each new scan",
        )
    return idempotency_key


@router.post("", status_code=202, dependencies=COMMAND)
def start_scan(
    body: ScanBody, key: Annotated[str, Depends(idempotency_key)], here: Here
) -> JSONResponse:
    """Start a scan. The same key and body give the same answer and start nothing twice."""
    spec = scan_spec(body, here.paths, here.caps, here.segmenter)
    digest = sha256(body.model_dump_json().encode()).hexdigest()
    status = here.scans.start(spec, key, digest)
    return JSONResponse(status, 202, headers={"Location": f"/v1/scans/{status['scan_id']}"})


@router.get("")
def list_scans(
    here: Here, limit: Annotated[int, Query(ge=1, le=200)] = 50, before: str | None = None
) -> dict[str, Any]:
    """List scans, newest first; `next` continues the list as `before`."""
    if before is not None:
        here.scans.record(before)  # an unknown one is a mistake, not the end of the list
    records = here.scans.catalogue.scans(limit, before)
    more = records[-1].scan_id if len(records) == limit else None
    return {"scans": [_fields(here, record) for record in records], "next": more}


@router.get("/{scan_id}")
def show_scan(scan_id: str, here: Here) -> dict[str, Any]:
    """Tell where a scan is, and what it was asked to do."""
    record = here.scans.record(scan_id)
    return _fields(here, record) | {"request": record.request}


def _fields(here: Context, record: ScanRecord) -> dict[str, Any]:
    return status_fields(here.scans.status_of(record)) | {
        "created": _rfc3339(record.created_ns),
        "updated": _rfc3339(record.updated_ns),
        "kind": record.kind.value,
    }


def _rfc3339(stamp_ns: int) -> str:
    return datetime.fromtimestamp(stamp_ns / 1e9, UTC).isoformat(timespec="milliseconds")


@router.post("/{scan_id}:pause", dependencies=COMMAND)
def pause_scan(scan_id: str, here: Here) -> dict[str, Any]:
    """Stop the arm and keep the scan."""
    return status_fields(here.scans.pause(scan_id))


@router.post("/{scan_id}:resume", dependencies=COMMAND)
def resume_scan(scan_id: str, here: Here) -> dict[str, Any]:
    """Go on at the first waypoint that is missing."""
    return status_fields(here.scans.resume(scan_id))


@router.post("/{scan_id}:cancel", dependencies=COMMAND)
def cancel_scan(scan_id: str, here: Here) -> dict[str, Any]:
    """Stop the arm and end the scan; its recording stays."""
    return status_fields(here.scans.cancel(scan_id))


@router.get("/{scan_id}/events", response_class=EventSourceResponse)
async def follow_scan(
    scan_id: KnownScan,
    here: Here,
    last_event_id: Annotated[int, Header(ge=0, le=MOST_NUMBER)] = 0,
) -> AsyncIterator[ServerSentEvent]:
    """Stream what happened and happens, after event `Last-Event-ID`; ends with the scan (`end`)."""
    seq, silent = last_event_id, False
    while not here.bell.closed:
        ring = here.bell.next_ring()
        last_words_s, events = await run_in_threadpool(_news, here, scan_id, seq)
        for event in events:
            seq = event.seq
            yield ServerSentEvent(id=str(seq), event=event.kind, data=event.data)
        if last_words_s and silent and not events:
            yield ServerSentEvent(event="end", data={})
            return
        silent = not await wait_for_ring(ring, last_words_s or _LOOK_AGAIN_S)


def _news(here: Context, scan_id: str, seq: int) -> tuple[float | None, list[EventRecord]]:
    """Return how long to wait for more of a scan that is over (None: it is not), and events."""
    record = here.scans.record(scan_id)
    over = here.scans.status_of(record).state in FINISHED
    last_words_s = _LAST_WORDS_S if record.state in FINISHED else _LAST_WORDS_UNNOTED_S
    return last_words_s if over else None, here.scans.catalogue.events(scan_id, seq)


@router.get("/{scan_id}/views/{index}/color.jpg", response_class=Response)
def color_picture(scan_id: KnownScan, index: int, here: Here) -> Response:
    """Return the colour picture of a view, as soon as it is recorded."""
    return _picture(here, scan_id, index, PictureKind.COLOR_JPEG)


@router.get("/{scan_id}/views/{index}/depth.png", response_class=Response)
def depth_picture(scan_id: KnownScan, index: int, here: Here) -> Response:
    """Return the depth picture of a view: 16 bit, millimetres, 0 = no return."""
    return _picture(here, scan_id, index, PictureKind.DEPTH_PNG)


def _picture(here: Context, scan_id: str, index: int, kind: PictureKind) -> Response:
    try:
        picture = here.pictures.read(here.scans.recording(scan_id), index, kind)
    except NoPictureError as error:
        raise Problem(404, "no_picture", "No such picture", str(error)) from error
    headers = {"Cache-Control": "public, max-age=31536000, immutable"}
    return Response(picture, media_type=kind.value, headers=headers)


@router.get("/{scan_id}/recording.mcap", response_class=Response)
def download_recording(
    scan_id: KnownScan,
    here: Here,
    asked: Annotated[str, Header(alias="range")] = "",
    if_range: Annotated[str, Header()] = "",
) -> Response:
    """Return the recording, or a range of it; while a scan grows, what is on disk by now."""
    stream = open_recorded(here.scans.recording(scan_id))
    if stream is None:
        raise Problem(404, "no_recording", "No recording", f"scan {scan_id} has no recording")
    name = f"{scan_id}.mcap"
    return file_response(stream, name, RECORDING_TYPE, asked=asked, if_range=if_range)
