"""Every error as an RFC 9457 problem document."""

import logging
import re
from collections.abc import Mapping
from http import HTTPStatus
from secrets import token_hex
from typing import Any

from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse
from pydantic import BaseModel
from sqlalchemy.exc import OperationalError
from starlette.exceptions import HTTPException
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from canopy_skel.errors import RecordingError, UsageError
from service.catalogue import KeyReusedError
from service.http.requests import UnknownPathError
from service.rig import (
    NoRoomError,
    NotForReplaysError,
    PlanRefusedError,
    RigBusyError,
    RigError,
    RigNotReadyError,
    ScanOverError,
    UnknownScanError,
)

logger = logging.getLogger(__name__)

MEDIA_TYPE = "application/problem+json"
LARGEST_BODY = 1 << 20
STOP_PATH = "/v1/rig:stop"
REPLAYS_PATH = "/v1/replays"
RECORDING_TYPE = "application/x-mcap"

# exception -> status, code, title
_KNOWN: Mapping[type[Exception], tuple[int, str, str]] = {
    UnknownScanError: (404, "unknown_scan", "No such scan"),
    RigBusyError: (409, "rig_busy", "The arm is busy with a scan"),
    ScanOverError: (409, "scan_over", "The scan has ended"),
    PlanRefusedError: (422, "plan_refused", "The arm cannot drive this"),
    UnknownPathError: (422, "unknown_path", "No such path"),
    KeyReusedError: (422, "idempotency_key_reused", "Idempotency-Key used for another request"),
    UsageError: (422, "bad_argument", "An argument does not fit"),
    RecordingError: (503, "recording_failed", "The recording cannot be used"),
    NoRoomError: (507, "no_room", "No room for the recording"),
    NotForReplaysError: (409, "is_replay", "Not for a replay"),
    RigNotReadyError: (503, "rig_not_ready", "Arm or camera cannot be used now"),
    RigError: (503, "rig_error", "The rig could not do it"),
}


class ProblemBody(BaseModel):
    """A problem document, RFC 9457. code: what a program should look at."""

    type: str
    title: str
    status: int
    detail: str
    instance: str
    code: str


class Problem(Exception):  # noqa: N818  # what RFC 9457 calls it
    """An error that already knows its answer; `more` are further members."""

    def __init__(
        self,
        status: int,
        code: str,
        title: str,
        detail: str,
        *,
        headers: Mapping[str, str] | None = None,
        more: Mapping[str, Any] | None = None,
    ) -> None:
        super().__init__(detail)
        self.status = status
        self.code = code
        self.title = title
        self.headers = headers
        self.more = more or {}


RESPONSES: dict[int | str, dict[str, Any]] = {
    "default": {
        "description": "Problem (RFC 9457)",
        "content": {MEDIA_TYPE: {"schema": ProblemBody.model_json_schema()}},
    }
}


def add_handlers(app: FastAPI) -> None:
    """Have every error of the app answered as a problem."""
    for kind in _KNOWN:
        app.add_exception_handler(kind, _known)
    app.add_exception_handler(OperationalError, _catalogue_fails)
    app.add_exception_handler(Problem, _problem)
    app.add_exception_handler(RequestValidationError, _invalid)
    app.add_exception_handler(HTTPException, _of_framework)
    app.add_middleware(LastResort, largest_body=LARGEST_BODY)


def is_recording(request: Request) -> bool:
    """Say whether the body is a recording, by what the request says of it."""
    content_type = request.headers.get("content-type", "")
    return content_type.partition(";")[0].strip().lower() == RECORDING_TYPE


def answer(request: Request, problem: Problem) -> JSONResponse:
    """Return the problem as a response."""
    body = {
        "type": f"urn:canopy:problem:{problem.code}",
        "title": problem.title,
        "status": problem.status,
        "detail": str(problem),
        "instance": request.url.path,
        "code": problem.code,
    }
    return JSONResponse(
        body | dict(problem.more), problem.status, headers=problem.headers, media_type=MEDIA_TYPE
    )


def _problem(request: Request, error: Exception) -> JSONResponse:
    assert isinstance(error, Problem)  # noqa: S101  # registered for nothing else
    return answer(request, error)


def _known(request: Request, error: Exception) -> JSONResponse:
    status, code, title = next(_KNOWN[kind] for kind in type(error).__mro__ if kind in _KNOWN)
    more = {"waypoints": refused_waypoints(error)} if isinstance(error, PlanRefusedError) else {}
    return answer(request, Problem(status, code, title, str(error), more=more))


def refused_waypoints(error: PlanRefusedError) -> list[dict[str, Any]]:
    """Return the waypoints that cannot be driven to, with the reason of each."""
    return [{"index": v.index, "reason": v.reason} for v in error.verdicts if not v.reachable]


def _catalogue_fails(request: Request, error: Exception) -> JSONResponse:
    logger.error("catalogue fails", exc_info=error)
    title = "The catalogue cannot be used"
    mend = "free space on the disk of the service's state folder, and check that it is writable"
    return answer(request, Problem(503, "catalogue_unavailable", title, mend))


def _invalid(request: Request, error: Exception) -> JSONResponse:
    assert isinstance(error, RequestValidationError)  # noqa: S101  # registered for nothing else
    errors = [
        {"where": ".".join(str(part) for part in one["loc"]), "what": one["msg"]}
        for one in error.errors()
    ]
    return answer(request, _invalid_request(errors))


def _invalid_request(errors: list[dict[str, str]]) -> Problem:
    detail = "; ".join(f"{one['where']}: {one['what']}" for one in errors[:3])
    title = "The request is not valid"
    return Problem(422, "invalid_request", title, detail, more={"errors": errors[:100]})


def _of_framework(request: Request, error: Exception) -> JSONResponse:
    assert isinstance(error, HTTPException)  # noqa: S101  # registered for nothing else
    if error.status_code == HTTPStatus.BAD_REQUEST and error.__cause__ is not None:
        # A body that could not even be parsed: not UTF-8, nested too deeply, digits without end.
        return answer(request, _invalid_request([{"where": "body", "what": str(error.__cause__)}]))
    title = HTTPStatus(error.status_code).phrase
    detail = f"{request.method} {request.url.path}: {error.detail}; see /openapi.json"
    code = re.sub(r"\W+", "_", title.lower())
    return answer(request, Problem(error.status_code, code, title, detail, headers=error.headers))


class LastResort:
    """Answers what no handler sees: bodies that are too long, and errors nobody foresaw.

    The handlers of the framework would answer the first as plain text, and close the connection
    after the second.
    """

    def __init__(self, app: ASGIApp, largest_body: int) -> None:
        self._app = app
        self._largest_body = largest_body

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Handle one request."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        started = False

        async def watched_send(message: Message) -> None:
            nonlocal started
            started = started or message["type"] == "http.response.start"
            await send(message)

        request = Request(scope)
        try:
            self._check_size(request)
            await self._app(scope, receive, watched_send)
        except Exception as error:
            if started:
                raise
            problem = error if isinstance(error, Problem) else _unexpected(error)
            await answer(request, problem)(scope, receive, send)

    def _check_size(self, request: Request) -> None:
        if request.url.path == STOP_PATH:
            return  # nothing keeps anybody from stopping the arm; its body is never read
        if "transfer-encoding" in request.headers:
            title = HTTPStatus(411).phrase
            raise Problem(411, "length_required", title, "send the body with a Content-Length")
        if request.url.path == REPLAYS_PATH and is_recording(request):
            return  # goes to the disk piece by piece, as far as that has room
        length = request.headers.get("content-length", "0")
        if length.isdecimal() and int(length) > self._largest_body:
            title = HTTPStatus(413).phrase
            detail = f"the body has {length} bytes; send at most {self._largest_body}"
            if request.url.path == REPLAYS_PATH:
                detail += f", or a recording as {RECORDING_TYPE}"
            raise Problem(413, "content_too_large", title, detail)


def _unexpected(error: Exception) -> Problem:
    trace_id = token_hex(8)
    logger.error("unexpected error trace_id=%s", trace_id, exc_info=error)
    return Problem(
        500,
        "internal_error",
        "Something went wrong in the service",
        f"the service's log tells more under trace_id={trace_id}",
        more={"trace_id": trace_id},
    )
