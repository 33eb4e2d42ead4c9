"""What a scan was asked to do, as JSON: kept so that a restarted service can go on with it."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from canopy_skel.canopy import CanopyConfig
from canopy_skel.likelihood import LikelihoodConfig
from canopy_skel.pipeline import MethodConfig, MethodName
from service.rig import ScanSpec

_PLAIN_FIELDS = ("tree_id", "segmenter", "speed_mps", "acceleration_mps2", "retakes")


def method_config(method: MethodName, voxel_size_m: float, *, rooted: bool = False) -> MethodConfig:
    """Return the method with a voxel size and all other settings as they come.

    rooted: method `canopy` joins everything into one tree, however unsure.
    """
    return MethodConfig(
        name=method,
        likelihood=LikelihoodConfig(voxel_size_m=voxel_size_m),
        canopy=CanopyConfig(rooted=rooted),
    )


def fields_of(spec: ScanSpec) -> dict[str, Any]:
    """Return what a spec asks for, ready for JSON."""
    return {name: getattr(spec, name) for name in _PLAIN_FIELDS} | {
        "waypoints": [pose.tolist() for pose in spec.waypoints],
        "method": spec.config.name,
        "voxel_size_m": spec.config.likelihood.voxel_size_m,
        "rooted": spec.config.canopy.rooted,
    }


def spec_from(scan_id: str, fields: Mapping[str, Any]) -> ScanSpec:
    """Return the spec that `fields_of` was given."""
    return ScanSpec(
        scan_id=scan_id,
        waypoints=tuple(np.array(pose, dtype=np.float64) for pose in fields["waypoints"]),
        config=method_config(
            fields["method"],
            fields["voxel_size_m"],
            # Requests kept by a service that could not root lack it.
            rooted=fields.get("rooted", False),
        ),
        **{name: fields[name] for name in _PLAIN_FIELDS},
    )
