"""What callers may ask for: the bodies of requests, and the ScanSpec each stands for."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from secrets import token_hex
from typing import Annotated, Literal, Self

import numpy as np
from numpy.typing import ArrayLike
from pydantic import Field, model_validator

from canopy_skel.cluster import FARTHEST_M
from canopy_skel.geometry import FloatArray
from canopy_skel.pipeline import DEFAULT_METHOD, MethodConfig, MethodName
from service.pose_fields import Fields, Pose, Positive
from service.rig import PlanRefusedError, ScanSpec
from service.specs import method_config

MOST_WAYPOINTS = 1000
SLOWEST_MPS = 0.005
GENTLEST_MPS2 = 0.01
"""Below these a move across the workspace would take longer than anybody watches it. Scans of
before there were such bounds are gone on with as they were asked for."""


@dataclass(frozen=True, kw_only=True, slots=True)
class SpeedCaps:
    """The fastest that may be asked for, of the flange."""

    speed_mps: float = 0.25
    acceleration_mps2: float = 0.5


class UnknownPathError(ValueError):
    """No path of this name; the message lists those there are."""


class Waypoint(Pose):
    """A pose of the flange (tool0) in base."""


class PlanBody(Fields):
    """Where to go: a path by name, or waypoints in order; one of both."""

    path: Annotated[str | None, Field(description="see `paths` of GET /v1/rig")] = None
    waypoints: Annotated[list[Waypoint] | None, Field(min_length=1, max_length=MOST_WAYPOINTS)] = (
        None
    )
    speed_mps: Annotated[
        Positive | None,
        Field(description=f"of the flange, from {SLOWEST_MPS}; default 0.25 m/s or the cap"),
    ] = None
    acceleration_mps2: Annotated[
        Positive | None,
        Field(description=f"of the flange, from {GENTLEST_MPS2}; default 0.5 m/s² or the cap"),
    ] = None

    @model_validator(mode="after")
    def _has_one_of_both(self) -> Self:
        if (self.path is None) == (self.waypoints is None):
            raise ValueError("give either path or waypoints")
        return self


TREE_ID = r"^[A-Za-z0-9][A-Za-z0-9._-]{0,63}$"
TreeId = Annotated[str, Field(pattern=TREE_ID)]


class MethodBody(Fields):
    """How the skeleton is to be made."""

    method: MethodName = DEFAULT_METHOD
    voxel_size_m: Annotated[float, Field(ge=0.001, le=0.05, allow_inf_nan=False)] = 0.005
    segmenter: Annotated[
        Literal["recorded", "unet"] | None,
        Field(
            description="where branch masks come from: the recording, as of cameras only a"
            " simulated one brings them, or the learned segmenter; without, whichever is there"
        ),
    ] = None
    farthest_m: Annotated[
        float,
        Field(
            gt=0.3,
            le=20.0,
            allow_inf_nan=False,
            description="wood farther from the camera is another tree's",
        ),
    ] = FARTHEST_M
    rooted: Annotated[
        bool,
        Field(description="join everything into one tree, however unsure; method canopy only"),
    ] = False
    fragments: Annotated[
        bool, Field(description="use small wood outside the masks; method canopy only")
    ] = True

    @model_validator(mode="after")
    def _suits_the_method(self) -> Self:
        if self.method != "canopy" and (self.rooted or not self.fragments):
            raise ValueError(
                f"rooted and fragments are for method canopy; leave them out with {self.method}"
            )
        return self

    def config(self) -> MethodConfig:
        """Return the method with these settings."""
        return method_config(
            self.method,
            self.voxel_size_m,
            farthest_m=self.farthest_m,
            rooted=self.rooted,
            fragments=self.fragments,
        )


class ScanBody(PlanBody, MethodBody):
    """What to scan and how."""

    tree_id: TreeId
    retakes: Annotated[int, Field(ge=0, le=10)] = 2


class ReplayBody(MethodBody):
    """Which recording to make a skeleton of, and how; an uploaded one has no `scan_id`."""

    scan_id: Annotated[
        str | None, Field(description="an ended scan of this service, whose recording is taken")
    ] = None
    tree_id: Annotated[TreeId | None, Field(description="without, what scan or recording say")] = (
        None
    )


class AcknowledgeBody(Fields):
    """Why it is safe to move again."""

    reason: Annotated[str, Field(min_length=3, max_length=500, pattern=r"\S")]


def plan_spec(
    body: PlanBody, paths: Mapping[str, Sequence[ArrayLike]], caps: SpeedCaps
) -> ScanSpec:
    """Return the motion a body asks for, under a new scan id and of no particular tree.

    Raises:
        UnknownPathError: there is no path of this name.
        PlanRefusedError: a speed is over its cap, or too low.
    """
    usual = SpeedCaps()
    return ScanSpec(
        scan_id=_new_scan_id(),
        tree_id="",
        waypoints=_waypoints(body, paths),
        config=MethodConfig(),
        speed_mps=_within(
            "speed_mps", body.speed_mps, SLOWEST_MPS, caps.speed_mps, usual.speed_mps
        ),
        acceleration_mps2=_within(
            "acceleration_mps2",
            body.acceleration_mps2,
            GENTLEST_MPS2,
            caps.acceleration_mps2,
            usual.acceleration_mps2,
        ),
    )


def scan_spec(
    body: ScanBody,
    paths: Mapping[str, Sequence[ArrayLike]],
    caps: SpeedCaps,
    segmenter: str = "recorded",
) -> ScanSpec:
    """Return the scan a body asks for, under a new scan id. Raises as `plan_spec`.

    segmenter: what finds the branches if the body names nothing.
    """
    return replace(
        plan_spec(body, paths, caps),
        tree_id=body.tree_id,
        config=body.config(),
        segmenter=body.segmenter or segmenter,
        retakes=body.retakes,
    )


def replay_spec(body: ReplayBody, tree_id: str, segmenter: str) -> ScanSpec:
    """Return the replay a body asks for, under a new scan id.

    tree_id, segmenter: where the body names none.
    """
    return ScanSpec(
        scan_id=_new_scan_id(),
        tree_id=body.tree_id or tree_id,
        waypoints=(),
        config=body.config(),
        segmenter=body.segmenter or segmenter,
    )


def _new_scan_id() -> str:
    return f"{datetime.now(UTC):%Y%m%dT%H%M%SZ}-{token_hex(4)}"


def _waypoints(body: PlanBody, paths: Mapping[str, Sequence[ArrayLike]]) -> tuple[FloatArray, ...]:
    if body.waypoints is not None:
        return tuple(waypoint.matrix() for waypoint in body.waypoints)
    if body.path is None or body.path not in paths:
        known = ", ".join(sorted(paths)) or "none"
        raise UnknownPathError(f"there is no path {body.path!r}; choose one of: {known}")
    return tuple(np.array(pose, dtype=np.float64) for pose in paths[body.path])


def _within(name: str, asked: float | None, least: float, cap: float, default: float) -> float:
    value = min(cap, default) if asked is None else asked
    if value > cap:
        raise PlanRefusedError(f"{name} {value:g} is over the cap of {cap:g}; ask for less")
    if value < least:
        raise PlanRefusedError(f"{name} {value:g} is under {least:g}; ask for more")
    return value
