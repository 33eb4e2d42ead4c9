"""The file that describes a real rig: its controller, its camera, its limits and its paths.

Nothing of it can be guessed: a wrong hand-eye calibration bends every skeleton, a wrong payload
weakens the controller's own safety, and another cell's limits let the arm into the trellis.
"""

import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Literal, Self

import numpy as np
from pydantic import Field, ValidationError, field_validator, model_validator

from canopy_skel.errors import UsageError
from canopy_skel.geometry import FloatArray
from drivers import guarded_arm
from drivers.oak.messages import OakConfig
from drivers.ur5.messages import Ur5Config
from service.http.requests import GENTLEST_MPS2, SLOWEST_MPS
from service.pose_fields import Fields, Finite, Pose, Positive

UR5_PAYLOAD_KG = 5.0
WATCHDOG_HZ = 2.0
"""The controller stops by itself when the driver is silent for half a second."""
_UNIT_TOLERANCE = 0.01
_DOCS = "docs/rig.md shows a whole file"

# What a UR5 and what hangs on it can have: a number in millimetres or degrees is outside.
_InReach = Annotated[Finite, Field(ge=-1.5, le=1.5)]
_OnTool = Annotated[Finite, Field(ge=-0.5, le=0.5)]
Place = tuple[_InReach, _InReach, _InReach]
PlaceOnTool = tuple[_OnTool, _OnTool, _OnTool]
Speed = Annotated[Positive, Field(ge=SLOWEST_MPS, le=1.0)]
Acceleration = Annotated[Positive, Field(ge=GENTLEST_MPS2, le=2.5)]
JointSpeed = Annotated[Positive, Field(ge=0.01, le=3.14)]
JointAcceleration = Annotated[Positive, Field(ge=0.01, le=10.0)]


class ArmFields(Fields):
    """`[arm]`: a UR5 and what its flange carries, camera and mount together."""

    host: Annotated[str, Field(pattern=r"^\S+$")]
    payload_kg: Annotated[Finite, Field(ge=0, le=UR5_PAYLOAD_KG)]
    payload_cog_m: PlaceOnTool


class PoseOnTool(Pose):
    """Where something is on the flange."""

    position: PlaceOnTool


class CameraFields(Fields):
    """`[camera]`: an OAK-D, and its place on the flange as hand-eye calibration found it."""

    tool_from_camera: PoseOnTool
    device: str = ""
    eye: Literal["color", "left"] = "color"


class KeepOutFields(Fields):
    """`[[limits.keep_outs]]`: the arm stays where normal · p >= offset_m, in base."""

    name: Annotated[str, Field(min_length=1)]
    normal: tuple[Finite, Finite, Finite]
    offset_m: _InReach

    @field_validator("normal")
    @classmethod
    def _has_unit_length(cls, value: tuple[float, ...]) -> tuple[float, ...]:
        length = float(np.linalg.norm(value))
        if abs(length - 1) > _UNIT_TOLERANCE:
            raise ValueError(f"has length {length:.4g}; give a unit vector")
        return value


class LimitFields(Fields):
    """`[limits]`: what the arm may do; see `drivers.guarded_arm.Limits`."""

    box_min_m: Place
    box_max_m: Place
    tool_points_m: Annotated[list[PlaceOnTool], Field(min_length=1)]
    keep_outs: tuple[KeepOutFields, ...] = ()
    body_radius_m: Annotated[Positive, Field(ge=0.05, le=0.3)] = 0.15
    speed_mps: Speed = 0.25
    acceleration_mps2: Acceleration = 0.5
    joint_speed_rps: JointSpeed = 1.0
    joint_acceleration_rps2: JointAcceleration = 1.5

    @model_validator(mode="after")
    def _has_room(self) -> Self:
        if any(low >= high for low, high in zip(self.box_min_m, self.box_max_m, strict=True)):
            raise ValueError("box_min_m must be below box_max_m in each of x, y and z")
        return self


class RigFile(Fields):
    """A whole rig file."""

    arm: ArmFields
    camera: CameraFields
    limits: LimitFields
    paths: Mapping[str, Annotated[list[Pose], Field(min_length=1)]] = {}

    def arm_config(self) -> Ur5Config:
        """Return how the arm is reached and looked after."""
        return Ur5Config(**self.arm.model_dump(), watchdog_hz=WATCHDOG_HZ)

    def camera_config(self) -> OakConfig:
        """Return which camera it is and what it delivers."""
        return OakConfig(device=self.camera.device, eye=self.camera.eye)

    def guard(self) -> guarded_arm.Limits:
        """Return what the arm may do."""
        own = self.limits.model_dump(exclude={"tool_points_m", "keep_outs"})
        return guarded_arm.Limits(
            **own,
            keep_outs=tuple(
                guarded_arm.KeepOut(**one.model_dump()) for one in self.limits.keep_outs
            ),
            tool_points_in_tool0=np.array(self.limits.tool_points_m, dtype=np.float64),
        )

    def waypoints(self) -> dict[str, list[FloatArray]]:
        """Return base_from_tool0 (4, 4) of every waypoint, by the name of its path."""
        return {name: [pose.matrix() for pose in path] for name, path in self.paths.items()}


def read_rig_file(path: Path) -> RigFile:
    """Return what a rig file (TOML) says.

    Raises:
        UsageError: there is no such file, or something in it is missing, unknown or out of range;
            the message names each place.
    """
    try:
        fields = tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise UsageError(f"no rig file {path} ({error.strerror}); {_DOCS}") from error
    except ValueError as error:  # of TOML or of UTF-8
        raise UsageError(f"rig file {path} is not TOML: {error}; {_DOCS}") from error
    try:
        return RigFile.model_validate(fields)
    except ValidationError as error:
        wrong = "; ".join(
            f"{'.'.join(str(step) for step in one['loc'])}: {one['msg']}" for one in error.errors()
        )
        raise UsageError(f"rig file {path}: {wrong}; {_DOCS}") from error
