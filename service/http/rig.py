"""Routes of the rig: is it ready, stop it, let it move again, what could it drive."""

import asyncio
from typing import Any

from fastapi import APIRouter

from service.http.access import COMMAND
from service.http.context import Here
from service.http.problems import STOP_PATH, Problem
from service.http.requests import AcknowledgeBody, PlanBody, plan_spec
from service.rig import PartStatus, status_fields

router = APIRouter(tags=["rig"])
stop_router = APIRouter(tags=["rig"])
"""Of its own, because nothing that guards the others may keep anybody from stopping the arm."""
OPTIONAL_PARTS = frozenset({"worker"})


@router.get("/healthz")
def healthz() -> dict[str, str]:
    """Say that the process answers."""
    return {"status": "ok"}


@router.get("/readyz")
def readyz(here: Here) -> dict[str, Any]:
    """Say whether a scan could start now; a missing worker only leaves skeletons pending."""
    parts = here.rig.parts()
    missing = [part for part in parts if not part.ready and part.name not in OPTIONAL_PARTS]
    if missing:
        detail = "; ".join(f"{part.name}: {part.detail}" for part in missing)
        raise Problem(503, "not_ready", "Not ready", detail, more={"parts": _fields(parts)})
    return {"ready": True, "parts": _fields(parts)}


@router.get("/v1/rig")
def show_rig(here: Here) -> dict[str, Any]:
    """Tell the state of every part, the scan that can still go on, and what may be asked for."""
    active = here.scans.active()
    return {
        "parts": _fields(here.rig.parts()),
        "scan": active and status_fields(active),
        "paths": {name: len(path) for name, path in sorted(here.paths.items())},
        "caps": {
            "speed_mps": here.caps.speed_mps,
            "acceleration_mps2": here.caps.acceleration_mps2,
        },
    }


@stop_router.post(STOP_PATH)
async def stop(here: Here) -> dict[str, str]:
    """Stop the arm now; no condition, never queued, harmless when repeated."""
    await asyncio.to_thread(here.scans.stop)  # not in the pool that other requests may fill
    return {"status": "stopped"}


@router.post("/v1/rig:acknowledge", dependencies=COMMAND)
def acknowledge(body: AcknowledgeBody, here: Here) -> dict[str, str]:
    """Let the arm move again after a stop: an operator has looked and says why it is safe."""
    here.scans.acknowledge(body.reason)
    return {"status": "acknowledged"}


@router.post("/v1/plans", dependencies=COMMAND)
def plan(body: PlanBody, here: Here) -> dict[str, Any]:
    """Tell for every waypoint whether the arm can drive there; nothing moves."""
    verdicts = here.rig.plan(plan_spec(body, here.paths, here.caps))
    waypoints = [{"index": v.index, "reachable": v.reachable, "reason": v.reason} for v in verdicts]
    return {"feasible": all(v.reachable for v in verdicts), "waypoints": waypoints}


def _fields(parts: list[PartStatus]) -> list[dict[str, Any]]:
    return [
        {"name": part.name, "ready": part.ready, "detail": part.detail or _fallback(part)}
        for part in parts
    ]


def _fallback(part: PartStatus) -> str:
    pending = not part.ready and part.name in OPTIONAL_PARTS
    return "none is running: skeletons are pending until one is" if pending else ""
