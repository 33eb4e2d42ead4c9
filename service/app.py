"""The HTTP app: built around a rig and a catalogue, which are handed in."""

from collections.abc import AsyncIterator, Mapping, Sequence
from contextlib import asynccontextmanager
from importlib import resources
from importlib.metadata import version

from fastapi import APIRouter, Depends, FastAPI
from fastapi.responses import HTMLResponse
from fastapi.staticfiles import StaticFiles
from numpy.typing import ArrayLike

from service.bell import Bell
from service.catalogue import Catalogue
from service.http import metrics as metric_routes
from service.http import planners as planner_routes
from service.http import replays as replay_routes
from service.http import rig as rig_routes
from service.http import scans as scan_routes
from service.http import skeletons as skeleton_routes
from service.http.access import Access, refuse_unknown_names
from service.http.context import Context
from service.http.problems import RESPONSES, add_handlers
from service.http.requests import SpeedCaps
from service.pictures import Pictures
from service.rig import Rig
from service.scans import Scans


def create_app(
    rig: Rig,
    catalogue: Catalogue,
    paths: Mapping[str, Sequence[ArrayLike]],
    caps: SpeedCaps | None = None,
    *,
    segmenter: str = "recorded",
    access: Access | None = None,
) -> FastAPI:
    """Return the app; its lifespan recovers the catalogue and follows the rig's events.

    Args:
        rig: what moves and sees.
        catalogue: entered by the caller, and left after the app has ended.
        paths: base_from_tool0 (4, 4) waypoints by the name that `path` in a request gives.
        caps: the fastest that may be asked for.
        segmenter: what finds the branches of a scan whose request names none.
        access: who is let in; everybody who comes by IP address or `localhost`, without it.
    """
    bell = Bell()
    scans = Scans(rig, catalogue, bell)

    @asynccontextmanager
    async def lifespan(app: FastAPI) -> AsyncIterator[None]:
        bell.open()
        with scans:
            yield

    app = FastAPI(
        title="canopy",
        version=version("canopy-skel"),
        lifespan=lifespan,
        responses=RESPONSES,
        docs_url=None,
        redoc_url=None,
    )
    app.state.context = Context(
        rig=rig,
        scans=scans,
        bell=bell,
        pictures=Pictures(),
        paths=paths,
        caps=caps or SpeedCaps(),
        segmenter=segmenter,
        uploads=catalogue.uploads,
    )
    app.state.access = access or Access()
    add_handlers(app)
    app.include_router(rig_routes.stop_router)
    routes = (
        rig_routes,
        metric_routes,
        scan_routes,
        replay_routes,
        planner_routes,
        skeleton_routes,
    )
    for router in (_page, *(module.router for module in routes)):
        app.include_router(router, dependencies=[Depends(refuse_unknown_names)])
    app.mount("/console", StaticFiles(packages=[("service", "console")]))
    return app


def end_streams(app: FastAPI) -> None:
    """Have every open event stream and long poll end now; may be called by a signal handler."""
    context: Context = app.state.context
    context.bell.close()


def end_motion(app: FastAPI) -> None:
    """Have the scan under way end and none begin any more; returns when nothing moves."""
    context: Context = app.state.context
    context.rig.end()


_page = APIRouter()


@_page.get("/", response_class=HTMLResponse, include_in_schema=False)
def operator_page() -> str:
    """Return the operator's page."""
    return resources.files("service").joinpath("console/index.html").read_text(encoding="utf-8")
