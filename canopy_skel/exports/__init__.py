"""The files a skeleton document can be written as, by the ending of their name."""

from collections.abc import Callable, Mapping
from types import MappingProxyType

from canopy_skel.document import SkeletonDocument, to_json
from canopy_skel.exports.cylinders import write_cylinders
from canopy_skel.exports.gltf import write_glb
from canopy_skel.exports.graphml import write_graphml
from canopy_skel.exports.ply import write_ply
from canopy_skel.exports.swc import write_swc

FORMATS: Mapping[str, Callable[[SkeletonDocument], bytes]] = MappingProxyType(
    {
        "json": to_json,
        "glb": write_glb,
        "swc": write_swc,
        "ply": write_ply,
        "csv": write_cylinders,
        "graphml": write_graphml,
    }
)
