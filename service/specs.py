"""What a scan was asked to do, as JSON: kept so that a restarted service can go on with it."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from canopy_skel.canopy import CanopyConfig
from canopy_skel.cluster import FARTHEST_M, ClusterConfig
from canopy_skel.likelihood import LikelihoodConfig
from canopy_skel.pieces import PieceConfig
from canopy_skel.pipeline import MethodConfig, MethodName
from service.rig import ScanSpec

_PLAIN_FIELDS = ("tree_id", "segmenter", "speed_mps", "acceleration_mps2", "retakes")


def method_config(
    method: MethodName,
    voxel_size_m: float,
    *,
    farthest_m: float = FARTHEST_M,
    rooted: bool = False,
    fragments: bool = True,
) -> MethodConfig:
    """Return the method with what a user may set, and all other settings as they come.

    farthest_m: wood farther from the camera is another tree's. rooted: method `canopy` joins
    everything into one tree, however unsure. fragments: it uses small wood outside the masks.
    """
    return MethodConfig(
        name=method,
        cluster=ClusterConfig(farthest_m=farthest_m),
        likelihood=LikelihoodConfig(voxel_size_m=voxel_size_m),
        canopy=CanopyConfig(
            pieces=PieceConfig(farthest_m=farthest_m), rooted=rooted, use_fragments=fragments
        ),
    )


def fields_of(spec: ScanSpec) -> dict[str, Any]:
    """Return what a spec asks for, ready for JSON."""
    return {name: getattr(spec, name) for name in _PLAIN_FIELDS} | {
        "waypoints": [pose.tolist() for pose in spec.waypoints],
        "method": spec.config.name,
        "voxel_size_m": spec.config.likelihood.voxel_size_m,
        "farthest_m": spec.config.cluster.farthest_m,
        "rooted": spec.config.canopy.rooted,
        "fragments": spec.config.canopy.use_fragments,
    }


def spec_from(scan_id: str, fields: Mapping[str, Any]) -> ScanSpec:
    """Return the spec that `fields_of` was given."""
    return ScanSpec(
        scan_id=scan_id,
        waypoints=tuple(np.array(pose, dtype=np.float64) for pose in fields["waypoints"]),
        config=method_config(
            fields["method"],
            fields["voxel_size_m"],
            # Requests kept by a service that could not set these lack them.
            farthest_m=fields.get("farthest_m", FARTHEST_M),
            rooted=fields.get("rooted", False),
            fragments=fields.get("fragments", True),
        ),
        **{name: fields[name] for name in _PLAIN_FIELDS},
    )
