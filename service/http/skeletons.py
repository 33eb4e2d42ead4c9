"""Routes of skeletons: newest or by revision, in every format, with validators and long poll."""

from dataclasses import dataclass
from hashlib import sha256
from time import perf_counter
from types import MappingProxyType
from typing import Annotated

from fastapi import APIRouter, Header, Path, Response
from fastapi.concurrency import run_in_threadpool

from canopy_skel.document import from_json
from canopy_skel.exports import FORMATS
from canopy_skel.schema import schema_text
from service.bell import wait_for_ring
from service.catalogue import MOST_NUMBER, RevisionRecord
from service.http.context import Context, Here, KnownScan
from service.http.negotiation import best_media_type, matches, wait_s
from service.http.problems import Problem

router = APIRouter(tags=["skeletons"])

MEDIA_TYPES = MappingProxyType(
    {
        "json": "application/json",
        "glb": "model/gltf-binary",
        "swc": "text/x-swc",
        "ply": "model/ply",
        "csv": "text/csv",
        "graphml": "application/graphml+xml",
    }
)
Accept = Annotated[str, Header()]
IfNoneMatch = Annotated[str, Header()]
Prefer = Annotated[str, Header()]
Revision = Annotated[int, Path(le=MOST_NUMBER)]


@dataclass(frozen=True, kw_only=True, slots=True)
class Rendered:
    """A skeleton revision in a format. final: it will never change."""

    content: bytes
    media_type: str
    revision: int
    final: bool

    @property
    def etag(self) -> str:
        """The strong validator of these bytes."""
        return f'"{sha256(self.content).hexdigest()}"'


@router.get("/v1/schemas/canopy-skeleton-1.json", response_class=Response)
def document_schema() -> Response:
    """Return the JSON Schema of skeleton documents."""
    return Response(schema_text(), media_type="application/schema+json")


@router.get("/v1/scans/{scan_id}/skeleton", response_class=Response)
async def newest_skeleton(
    scan_id: KnownScan,
    here: Here,
    accept: Accept = "*/*",
    if_none_match: IfNoneMatch = "",
    prefer: Prefer = "",
) -> Response:
    """Return the newest skeleton as `Accept` asks; `Prefer: wait=N` waits for a newer one."""
    return await _newest(here, scan_id, _negotiated(accept), if_none_match, prefer)


@router.get("/v1/scans/{scan_id}/skeleton.{suffix}", response_class=Response)
async def newest_skeleton_as(
    scan_id: KnownScan,
    suffix: str,
    here: Here,
    if_none_match: IfNoneMatch = "",
    prefer: Prefer = "",
) -> Response:
    """Return the newest skeleton as json, glb, swc, ply, csv or graphml."""
    return await _newest(here, scan_id, _known_format(suffix), if_none_match, prefer)


@router.get("/v1/scans/{scan_id}/skeleton/revisions/{revision}.{suffix}", response_class=Response)
def skeleton_revision_as(
    scan_id: KnownScan,
    revision: Revision,
    suffix: str,
    here: Here,
    if_none_match: IfNoneMatch = "",
) -> Response:
    """Return one revision as json, glb, swc, ply, csv or graphml."""
    return _one(here, scan_id, revision, _known_format(suffix), if_none_match)


@router.get("/v1/scans/{scan_id}/skeleton/revisions/{revision}", response_class=Response)
def skeleton_revision(
    scan_id: KnownScan,
    revision: Revision,
    here: Here,
    accept: Accept = "*/*",
    if_none_match: IfNoneMatch = "",
) -> Response:
    """Return one revision; all but the newest are final."""
    return _one(here, scan_id, revision, _negotiated(accept), if_none_match)


async def _newest(
    here: Context, scan_id: str, name: str, if_none_match: str, prefer: str
) -> Response:
    """Answer with the newest revision; wait while there is no news to tell."""
    wanted_s = wait_s(prefer)
    until_s = perf_counter() + wanted_s
    headers = {"Preference-Applied": f"wait={wanted_s}"} if wanted_s else {}
    while True:
        ring = here.bell.next_ring()
        rendered = await run_in_threadpool(_render_newest, here, scan_id, name)
        left_s = until_s - perf_counter()
        is_news = rendered is not None and not matches(if_none_match, rendered.etag)
        if is_news or left_s <= 0 or here.bell.closed:
            break
        await wait_for_ring(ring, left_s)
    if rendered is None:
        raise await run_in_threadpool(no_skeleton_yet, here, scan_id)
    return _respond(rendered, if_none_match, headers)


def _render_newest(here: Context, scan_id: str, name: str) -> Rendered | None:
    newest = here.scans.catalogue.newest_revision(scan_id)
    return None if newest is None else _render(newest, name, final=False)


def _one(here: Context, scan_id: str, revision: int, name: str, if_none_match: str) -> Response:
    found = here.scans.catalogue.revision(scan_id, revision)
    newest = here.scans.catalogue.newest_revision(scan_id)
    if found is None or newest is None:
        detail = f"scan {scan_id} has no revision {revision}; the newest: "
        detail += str(newest.revision) if newest else "none yet"
        raise Problem(404, "unknown_revision", "No such revision", detail)
    rendered = _render(found, name, final=revision < newest.revision)
    return _respond(rendered, if_none_match, {})


def _render(record: RevisionRecord, name: str, *, final: bool) -> Rendered:
    content = record.path.read_bytes()
    if name != "json":
        content = FORMATS[name](from_json(content, str(record.path)))
    return Rendered(
        content=content, media_type=MEDIA_TYPES[name], revision=record.revision, final=final
    )


def _respond(rendered: Rendered, if_none_match: str, more: dict[str, str]) -> Response:
    headers = {
        "ETag": rendered.etag,
        "Cache-Control": "public, max-age=31536000, immutable" if rendered.final else "no-cache",
        "Vary": "Accept",
        "Canopy-Revision": str(rendered.revision),
        **more,
    }
    if matches(if_none_match, rendered.etag):
        return Response(status_code=304, headers=headers)
    return Response(rendered.content, media_type=rendered.media_type, headers=headers)


def no_skeleton_yet(here: Context, scan_id: str) -> Problem:
    """Return the answer while a scan has no skeleton; it says so if no worker is there."""
    status = here.scans.status(scan_id)
    worker = [p for p in here.rig.parts() if p.name == "worker" and not p.ready]
    reason = f"; no worker: {worker[0].detail}" if worker else ""
    detail = (
        f"scan {scan_id} ({status.state.value}, {status.views_done} of {status.views_total} views)"
        f" has no skeleton yet{reason}"
    )
    title = "No skeleton yet"
    return Problem(404, "skeleton_pending", title, detail, headers={"Retry-After": "2"})


def _negotiated(accept: str) -> str:
    chosen = best_media_type(accept, list(MEDIA_TYPES.values()))
    if chosen is None:
        known = ", ".join(MEDIA_TYPES.values())
        raise Problem(406, "not_acceptable", "Not acceptable", f"Accept one of: {known}")
    return next(name for name, media_type in MEDIA_TYPES.items() if media_type == chosen)


def _known_format(suffix: str) -> str:
    if suffix not in MEDIA_TYPES:
        known = ", ".join(MEDIA_TYPES)
        raise Problem(404, "unknown_format", "No such format", f"{suffix!r} is none of: {known}")
    return suffix
