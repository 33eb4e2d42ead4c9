"""How wrong the reported pose of the camera is."""

from dataclasses import dataclass

import numpy as np

from canopy_skel.errors import UsageError
from canopy_skel.geometry import FloatArray, rotation_from_quaternion, transform_from


@dataclass(frozen=True, kw_only=True, slots=True)
class PoseNoise:
    """Standard deviations: of the hand-eye calibration (once per scan) and of each view."""

    hand_eye_m: float
    hand_eye_deg: float
    view_m: float
    view_deg: float


POSE_NOISE = {
    "none": PoseNoise(hand_eye_m=0.0, hand_eye_deg=0.0, view_m=0.0, view_deg=0.0),
    "nominal": PoseNoise(hand_eye_m=0.001, hand_eye_deg=0.1, view_m=0.0003, view_deg=0.03),
    "bad": PoseNoise(hand_eye_m=0.005, hand_eye_deg=0.5, view_m=0.0015, view_deg=0.15),
}


def pose_noise_named(name: str) -> PoseNoise:
    """Return the preset of that name.

    Raises:
        UsageError: there is no such preset.
    """
    if name not in POSE_NOISE:
        raise UsageError(f"unknown noise {name!r}; choose one of {', '.join(POSE_NOISE)}")
    return POSE_NOISE[name]


def small_transform(rng: np.random.Generator, sigma_m: float, sigma_deg: float) -> FloatArray:
    """Draw a (4, 4) transform near identity: a shift and a turn of these lengths on average.

    Each has a random direction and a normal length (root mean square: the given sigma).
    """
    shift = _direction(rng) * rng.normal(0, 1) * sigma_m
    half = 0.5 * rng.normal(0, 1) * np.radians(sigma_deg)
    axis = _direction(rng)
    quaternion = np.concatenate([np.sin(half) * axis, [np.cos(half)]])
    return transform_from(rotation_from_quaternion(quaternion), shift)


def _direction(rng: np.random.Generator) -> FloatArray:
    vector = rng.standard_normal(3)
    return np.asarray(vector / np.linalg.norm(vector))
