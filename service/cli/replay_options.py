"""What the verbs that replay recordings can be told."""

from pathlib import Path
from typing import Annotated

import typer

from canopy_skel.errors import UsageError
from canopy_skel.exports import FORMATS
from canopy_skel.pipeline import METHODS
from service.cli.shell import topic_options
from service.replay import ReplayRequest, map_memory_bytes
from service.segmenters import NAMES
from service.specs import method_config

VOXEL_M = 0.005
Method = Annotated[str, typer.Option(help=f"One of {', '.join(METHODS)}.")]
SegmenterName = Annotated[str, typer.Option(help=f"One of {', '.join(NAMES)}.")]
Weights = Annotated[Path | None, typer.Option(help="Weights of the segmenter (.pt).")]
Voxel = Annotated[float, typer.Option(help="Voxel size of the map in metres.")]
Formats = Annotated[str, typer.Option(help=f"Of {','.join(FORMATS)}.")]
Topics = Annotated[
    list[str] | None,
    typer.Option(help="ROLE=NAME, e.g. color_image=/rgb or base_frame=base_link; repeatable."),
]
Fragments = Annotated[bool, typer.Option(help="Use small wood outside the masks (method canopy).")]
Rooted = Annotated[
    bool,
    typer.Option("--rooted", help="Join everything into one tree, however unsure (canopy)."),
]


def replay_request(
    *,
    method: str,
    segmenter: str,
    weights: Path | None,
    voxel_m: float,
    formats: str,
    topics: list[str] | None,
    fragments: bool,
    farthest_m: float,
    rooted: bool,
    memory_bytes: int,
) -> ReplayRequest:
    """Return what the options ask for. memory_bytes: what each replay has to itself.

    Raises:
        UsageError: an option names what nobody knows, or does not fit the others.
    """
    if method in METHODS and method != "canopy" and (rooted or not fragments):
        raise UsageError(
            f"--rooted and --no-fragments are for method canopy; leave them out with {method}"
        )
    return ReplayRequest(
        config=method_config(
            method,  # type: ignore[arg-type]  # MethodConfig names the known ones
            voxel_m,
            farthest_m=farthest_m,
            rooted=rooted,
            fragments=fragments,
        ),
        segmenter=segmenter,
        weights=weights,
        formats=tuple(formats.split(",")),
        topics=topic_options(topics or []),
        memory_limit_bytes=map_memory_bytes(memory_bytes),
    )
