"""`canopy serve` and `canopy worker`."""

from pathlib import Path
from socket import gethostname
from typing import TYPE_CHECKING, Annotated

import typer

from canopy_skel.errors import UsageError
from canopy_skel.pipeline import METHODS
from service.access_keys import reaches_others, read_key
from service.kernels import compile_kernels
from service.outputs import require_writable
from service.skeletons import SEGMENTERS

if TYPE_CHECKING:
    from service.http.access import Access


def serve(
    sim: Annotated[
        bool, typer.Option("--sim", help="A simulated arm before a grown tree.")
    ] = False,
    robot: Annotated[
        Path | None, typer.Option(help="Rig file: a real arm and camera; see docs/rig.md.")
    ] = None,
    host: Annotated[str, typer.Option(help="Address to listen on.")] = "127.0.0.1",
    port: Annotated[int, typer.Option(help="Port to listen on.", min=0, max=65535)] = 8000,
    key_file: Annotated[
        Path | None,
        typer.Option(help="File with the key that commands must bring; needed beyond 127.0.0.1."),
    ] = None,
    name: Annotated[
        list[str] | None,
        typer.Option(help="Host name it is known by, without port; may be repeated."),
    ] = None,
    data: Annotated[Path, typer.Option(help="Folder of recordings and catalogue.")] = Path("data"),
    site: Annotated[str, typer.Option(help="Name of the site on the bus.")] = "orchard",
    rig: Annotated[str, typer.Option(help="Name of the rig on the bus.")] = "rig-1",
    bus: Annotated[
        str | None, typer.Option(help="Where the bus listens, for others on this machine.")
    ] = None,
    species: Annotated[str, typer.Option(help="Simulated tree: apple, oak, walnut.")] = "apple",
    topology: Annotated[int, typer.Option(help="Which tree of the species.")] = 0,
    leaves: Annotated[int, typer.Option(help="How many leaves it bears.")] = 500,
    time_scale: Annotated[
        float, typer.Option(help="Simulated arm: times real speed.", min=0.01)
    ] = 1.0,
    picture_scale: Annotated[float, typer.Option(help="Size of simulated pictures.")] = 1.0,
) -> None:
    """Run the scan service: the rig over HTTP, with a worker that makes skeletons."""
    # Only this command needs hardware, simulation and web, which take long to load.
    from mock_hw.orchard.simulate import Options
    from service.compose import ServeOptions, composed
    from service.rig_file import read_rig_file
    from service.server import listening, make_server

    if sim == (robot is not None):
        raise UsageError("give either --sim or --robot FILE, a rig file")
    rig_file = None if robot is None else read_rig_file(robot)
    access = _access(host, key_file, name or [])
    require_writable(data)
    options = ServeOptions(
        data=data,
        robot=rig_file,
        site=site,
        rig=rig,
        orchard=Options(species=species, topology=topology, leaf_count=leaves, weather="fair"),
        time_scale=time_scale,
        picture_scale=picture_scale,
        bus=bus,
        access=access,
    )
    with listening(host, port) as bound:
        compile_kernels((*METHODS, *SEGMENTERS))
        with composed(options) as service:
            make_server(service).run(sockets=[bound])


def _access(host: str, key_file: Path | None, names: list[str]) -> "Access":
    """Return who is let in where the service listens on `host`."""
    # Imported here: only serving needs the web.
    from service.http.access import Access

    for name in names:
        if ":" in name or "/" in name:
            raise UsageError(f"--name {name}: give the host's name alone, without scheme or port")
    others = reaches_others(host)
    if others and key_file is None:
        raise UsageError(
            f"--host {host} lets others reach the arm: give --key-file FILE, with a key that"
            " commands must bring along"
        )
    own = [gethostname(), f"{gethostname()}.local"] if others else []
    return Access(
        names=frozenset(name.lower() for name in (*names, *own)),
        key=None if key_file is None else read_key(key_file),
    )


def worker(arguments: Annotated[list[str] | None, typer.Argument()] = None) -> None:
    """Run a skeleton worker by itself: --connect ENDPOINT --site SITE --rig RIG [--id ID]."""
    # Imported here: only workers need the bus.
    from service.worker import main as run_worker

    run_worker(arguments or [])
