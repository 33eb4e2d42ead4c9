"""Rigid transforms, the pinhole camera and polylines, as pure functions on arrays."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]
IntArray = NDArray[np.int64]


def rotation_from_quaternion(xyzw: ArrayLike) -> FloatArray:
    """Return the (3, 3) rotation of the quaternion (x, y, z, w), which need not be normalised.

    Raises:
        ValueError: the quaternion is not finite or has no length.
    """
    q = np.asarray(xyzw, dtype=np.float64)
    norm = float(np.linalg.norm(q))
    if not np.isfinite(norm) or norm < 1e-9:
        raise ValueError(f"quaternion {q.tolist()} has no direction")
    x, y, z, w = q / norm
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def transform_from(rotation: FloatArray, translation_m: ArrayLike) -> FloatArray:
    """Return the (4, 4) transform with this (3, 3) rotation and (3,) translation in metres."""
    transform = np.eye(4)
    transform[:3, :3] = rotation
    transform[:3, 3] = translation_m
    return transform


def is_rigid(transform: FloatArray, tolerance: float = 1e-6) -> bool:
    """Say whether a (4, 4) matrix is finite, orthonormal, right-handed and homogeneous."""
    if transform.shape != (4, 4) or not np.isfinite(transform).all():
        return False
    rotation = transform[:3, :3]
    orthonormal = np.allclose(rotation @ rotation.T, np.eye(3), atol=tolerance)
    homogeneous = np.array_equal(transform[3], [0.0, 0.0, 0.0, 1.0])
    return bool(orthonormal and homogeneous and np.linalg.det(rotation) > 0)


def invert(transform: FloatArray) -> FloatArray:
    """Return the inverse of a rigid (4, 4) transform."""
    rotation = transform[:3, :3]
    return transform_from(rotation.T, -rotation.T @ transform[:3, 3])


def transform_points(target_from_source: FloatArray, points_in_source: FloatArray) -> FloatArray:
    """Map (N, 3) points by a (4, 4) transform."""
    return points_in_source @ target_from_source[:3, :3].T + target_from_source[:3, 3]
