"""Route of replays: a skeleton of a recording that was sent along, or of one that is here."""

import os
import re
import shutil
from collections.abc import AsyncIterator, Mapping
from hashlib import sha256
from pathlib import Path
from secrets import token_hex
from typing import Any

from fastapi import APIRouter, Request
from fastapi.concurrency import run_in_threadpool
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse
from pydantic import ValidationError
from starlette.requests import ClientDisconnect

from canopy_skel.errors import RecordingError
from service.http.access import COMMAND
from service.http.context import Context, Here
from service.http.problems import RECORDING_TYPE, REPLAYS_PATH, Problem, is_recording
from service.http.requests import TREE_ID, ReplayBody, replay_spec
from service.http.scans import Key
from service.pictures import recorded_file
from service.replays import has_masks, replayable
from service.rig import FINISHED

router = APIRouter(tags=["scans"])
ROOM_LEFT_BYTES = 1 << 30
"""An upload leaves this much of the disk to the recordings of scans."""
_SCHEMA = ReplayBody.model_json_schema()
_TWO_BODIES = {
    "requestBody": {
        "required": True,
        "content": {
            "application/json": {"schema": _SCHEMA},
            RECORDING_TYPE: {"schema": {"type": "string", "format": "binary"}},
        },
    },
    "parameters": [
        {"in": "query", "name": name, "schema": schema}
        for name, schema in _SCHEMA["properties"].items()
        if name != "scan_id"
    ],
}


@router.post(REPLAYS_PATH, status_code=202, dependencies=COMMAND, openapi_extra=_TWO_BODIES)
async def start_replay(request: Request, here: Here, idempotency_key: Key = None) -> JSONResponse:
    """Make a skeleton of an ended scan's recording, or of one that is sent; nothing moves.

    Sent as `application/x-mcap`, with the other fields of the JSON body in the query.
    """
    if not is_recording(request):
        body = _asked(await request.body())
        return await run_in_threadpool(_replay_stored, here, body, idempotency_key)
    body = _asked(dict(request.query_params))
    if body.scan_id is not None:
        raise _invalid("query.scan_id", "send a recording, or name a scan")
    key = idempotency_key
    used = await run_in_threadpool(here.scans.catalogue.used_key, key) if key else None
    if used is not None:  # it is here, and there may be no room for it a second time
        return _accepted(used.answer(_digest(body, await _hashed(request))))
    file = await run_in_threadpool(_take_room, here.uploads, _length(request))
    try:
        content = await _receive(request, file)
        return await run_in_threadpool(_replay, here, body, file, content, key)
    finally:
        file.unlink(missing_ok=True)


def _asked(given: bytes | dict[str, str]) -> ReplayBody:
    try:
        if isinstance(given, bytes):
            return ReplayBody.model_validate_json(given)
        return ReplayBody.model_validate(given)
    except ValidationError as error:
        where = "body" if isinstance(given, bytes) else "query"
        errors = [one | {"loc": (where, *one["loc"])} for one in error.errors()]
        raise RequestValidationError(errors) from error


def _invalid(where: str, what: str) -> RequestValidationError:
    return RequestValidationError([{"loc": tuple(where.split(".")), "msg": what}])


def _replay_stored(here: Context, body: ReplayBody, key: str | None) -> JSONResponse:
    if body.scan_id is None:
        raise _invalid("body.scan_id", f"name an ended scan, or send one as {RECORDING_TYPE}")
    record = here.scans.record(body.scan_id)
    state = here.scans.status_of(record).state
    if state not in FINISHED:
        detail = f"scan {body.scan_id} is {state.value}: wait for its end, or cancel it"
        raise Problem(409, "scan_under_way", "The scan has not ended", detail)
    file = recorded_file(here.scans.recording(body.scan_id))
    if file is None:
        raise Problem(404, "no_recording", "No recording", f"scan {body.scan_id} has no recording")
    return _replay(here, body, file, body.scan_id, key, record.tree_id)


def _replay(
    here: Context,
    body: ReplayBody,
    file: Path,
    content: str,
    key: str | None,
    tree_id: str | None = None,
) -> JSONResponse:
    """Start it. content: what tells the recording from others."""
    try:
        recording = replayable(file)
    except RecordingError as error:
        detail = str(error).removeprefix(f"{file}: ")
        raise Problem(422, "unusable_recording", "The recording cannot be used", detail) from error
    masks = has_masks(recording)
    if body.segmenter == "recorded" and not masks:
        detail = "it holds no branch masks; leave the segmenter out, or ask for unet"
        raise Problem(422, "unusable_recording", "The recording cannot be used", detail)
    said = recording.metadata.get("tree_id", "")
    tree_id = tree_id or (said if re.fullmatch(TREE_ID, said) else "unnamed")
    spec = replay_spec(body, tree_id, "recorded" if masks else "unet")
    return _accepted(here.scans.replays.start(spec, recording, key, _digest(body, content)))


def _digest(body: ReplayBody, content: str) -> str:
    return sha256(f"{body.model_dump_json()} {content}".encode()).hexdigest()


def _accepted(status: Mapping[str, Any]) -> JSONResponse:
    return JSONResponse(status, 202, headers={"Location": f"/v1/scans/{status['scan_id']}"})


def _length(request: Request) -> int:
    length = request.headers.get("content-length", "")
    if not length.isdecimal():
        raise Problem(411, "length_required", "Length Required", "send it with a Content-Length")
    return int(length)


def _take_room(folder: Path, length: int) -> Path:
    """Return a new file of so many bytes: uploads beside each other see what room is left.

    Raises:
        Problem: the disk has not enough; there is no file then.
    """
    file = folder / f"{token_hex(8)}.mcap"
    title = "No room for the recording"
    free = shutil.disk_usage(folder).free
    if free - length < ROOM_LEFT_BYTES:
        detail = f"it has {length >> 20} MiB, and {free >> 20} MiB are free, of which"
        detail += f" {ROOM_LEFT_BYTES >> 20} are kept for scans; make room"
        raise Problem(507, "no_room", title, detail)
    try:
        with file.open("wb") as stream:
            if length:
                os.posix_fallocate(stream.fileno(), 0, length)
    except OSError as error:
        file.unlink(missing_ok=True)
        raise Problem(507, "no_room", title, f"it cannot be written: {error.strerror}") from error
    return file


async def _receive(request: Request, file: Path) -> str:
    """Write the body to a file, durably, and return its SHA-256."""
    digest = sha256()
    title = "No room for the recording"
    try:
        with file.open("r+b") as stream:
            async for piece in _pieces(request):
                digest.update(piece)
                await run_in_threadpool(stream.write, piece)
            stream.flush()
            await run_in_threadpool(os.fsync, stream.fileno())
    except OSError as error:
        raise Problem(507, "no_room", title, f"it cannot be written: {error.strerror}") from error
    return digest.hexdigest()


async def _hashed(request: Request) -> str:
    """Return the SHA-256 of the body."""
    digest = sha256()
    async for piece in _pieces(request):
        digest.update(piece)
    return digest.hexdigest()


async def _pieces(request: Request) -> AsyncIterator[bytes]:
    try:
        async for piece in request.stream():
            yield piece
    except ClientDisconnect as error:
        title = "The recording did not arrive"
        raise Problem(400, "upload_broken_off", title, "send it again, to its end") from error
