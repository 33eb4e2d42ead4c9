"""What is written by people and programs: strict fields, and poses as position and quaternion."""

from typing import Annotated

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, field_validator

from canopy_skel.geometry import FloatArray, rotation_from_quaternion, transform_from

_UNIT_TOLERANCE = 0.01

Finite = Annotated[float, Field(strict=True, allow_inf_nan=False)]
Positive = Annotated[float, Field(strict=True, gt=0, allow_inf_nan=False)]


class Fields(BaseModel):
    """Base of all that others write: a misspelt name is an error, never ignored."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class Pose(Fields):
    """Where one frame is in another."""

    position: Annotated[tuple[Finite, Finite, Finite], Field(description="metres")]
    quaternion_xyzw: tuple[Finite, Finite, Finite, Finite]

    @field_validator("quaternion_xyzw")
    @classmethod
    def _has_unit_length(cls, value: tuple[float, ...]) -> tuple[float, ...]:
        length = float(np.linalg.norm(value))
        if abs(length - 1) > _UNIT_TOLERANCE:
            raise ValueError(f"has length {length:.4g}; give a unit quaternion (x, y, z, w)")
        return value

    def matrix(self) -> FloatArray:
        """Return the pose as (4, 4)."""
        return transform_from(rotation_from_quaternion(self.quaternion_xyzw), self.position)
