"""The only place that chooses between real hardware and simulation, and starts the processes."""

import logging
import os
import socket
import sys
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager, nullcontext
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

from fastapi import FastAPI

from canopy_skel.document import to_json
from canopy_skel.geometry import FloatArray, invert
from canopy_skel.messages import Message
from canopy_skel.recording.reader import GROUND_TRUTH
from drivers.guarded_arm import GuardedArm, KeepOut, Limits
from drivers.oak.camera import OakCamera
from drivers.protocols import Arm, Camera
from drivers.ur5.arm import Ur5Arm
from drivers.ur5.messages import Ur5Config
from mock_hw.fake_ur.process import FakeUr, free_host
from mock_hw.orchard.path import TOOL_FROM_CAMERA, camera_path
from mock_hw.orchard.simulate import Options, prepare
from mock_hw.sim_camera import SimCamera
from service.app import create_app
from service.broadcast import Broadcast
from service.bus import Keys, open_session
from service.catalogue import Catalogue
from service.feeder import ViewFeeder
from service.heartbeat import Version
from service.http.access import Access
from service.http.requests import SpeedCaps
from service.local_rig import LocalRig
from service.offered import ScanSource
from service.pictures import recorded_file
from service.rig import CAUGHT_UP, PartStatus, ScanSpec
from service.rig_file import WATCHDOG_HZ, RigFile
from service.rig_parts import RigParts
from service.scan import Attachments, Stage
from service.supervisor import Supervised

_log = logging.getLogger(__name__)

SIMULATED_LIMITS = Limits(
    box_min_m=(-0.9, -0.9, -0.85),
    box_max_m=(0.9, 0.9, 1.1),
    keep_outs=(KeepOut(name="tree row", normal=(-1.0, 0.0, 0.0), offset_m=-0.75),),
)
SIMULATED_PATHS: Mapping[str, list[FloatArray]] = {
    f"orchard-{views}": [pose @ invert(TOOL_FROM_CAMERA) for pose in camera_path(views)]
    for views in (10, 70)
}


@dataclass(frozen=True, kw_only=True, slots=True)
class ServeOptions:
    """What `canopy serve` is told. data: folder of recordings and catalogue.

    robot: the real rig; None = simulation, of which `orchard` says what stands there,
    `time_scale` how much faster than real the arm moves and `picture_scale` the size of pictures.
    bus: where the bus listens, such as "tcp/127.0.0.1:7447"; None = on a free port. access: who is
    let in over HTTP.
    """

    data: Path
    robot: RigFile | None
    site: str
    rig: str
    orchard: Options
    time_scale: float
    picture_scale: float
    bus: str | None = None
    access: Access = field(default_factory=Access)


@dataclass(frozen=True, kw_only=True, eq=False, slots=True)
class Hardware:
    """Arm and camera, the hand-eye calibration, limits and paths of where they stand.

    attachments: files that go with each recording: the rig file, or what a simulation knows.
    stage: entered around each step of a scan, for who wants to time it. segmenter: what finds the
    branches where a request names none; only a simulated camera brings their masks along.
    """

    arm: Arm
    camera: Camera
    tool_from_camera: FloatArray
    limits: Limits
    paths: Mapping[str, Sequence[FloatArray]]
    attachments: Attachments
    stage: Stage = lambda name: nullcontext()
    segmenter: str = "recorded"


class BusFeed:
    """The feed of a rig: the bus, and behind it a worker. See `service.local_rig.Feed`."""

    def __init__(self, feeder: ViewFeeder) -> None:
        self._feeder = feeder

    def begin(self, spec: ScanSpec, path: Path) -> None:
        """Turn to a scan."""
        self._feeder.begin(_source(spec, path))

    def catch_up(self, spec: ScanSpec, path: Path) -> None:
        """Have the views of a recording sent that has ended before."""
        self._feeder.catch_up(_source(spec, path))

    def leave(self, scan_id: str) -> None:
        """Have no more views of such a recording sent."""
        self._feeder.leave(scan_id)

    def offer(self, scan_id: str, index: int, messages: Sequence[Message]) -> None:
        """Have a recorded view sent."""
        self._feeder.offer(index, messages)

    def skeleton(self, scan_id: str) -> bytes | None:
        """Return the newest document."""
        return self._feeder.latest_skeleton(scan_id)

    def worker(self) -> PartStatus:
        """Say whether a worker is there."""
        return self._feeder.worker_status()

    def flush(self, timeout_s: float) -> bool:
        """Wait for the skeleton of all that was offered."""
        return self._feeder.flush(timeout_s)


def _source(spec: ScanSpec, path: Path) -> ScanSource:
    return ScanSource(
        scan_id=spec.scan_id,
        config=spec.config,
        segmenter=spec.segmenter,
        recording=lambda: recorded_file(path) or path,
        replay=not spec.waypoints,
    )


@contextmanager
def composed(
    options: ServeOptions,
    hardware_of: Callable[[ServeOptions], AbstractContextManager[Hardware]] | None = None,
) -> Iterator[FastAPI]:
    """Start everything but the HTTP server and give its app; ends it all on leaving.

    `hardware_of` brings other hardware than the options name.
    """
    with ExitStack() as stack:
        catalogue = stack.enter_context(Catalogue(options.data))  # refused before anything starts
        hardware = stack.enter_context((hardware_of or _hardware)(options))
        endpoint = options.bus or f"tcp/127.0.0.1:{free_port()}"
        session = stack.enter_context(open_session(listen=endpoint))
        stack.enter_context(Supervised("worker", worker_command(options, endpoint)))
        keys = Keys(site=options.site, rig=options.rig)
        feeder = stack.enter_context(
            ViewFeeder(
                session,
                keys,
                lambda *news: announce(*news),
                lambda *news: announce_caught_up(*news),
            )
        )
        rig = LocalRig(
            RigParts(
                arm=hardware.arm,
                camera=hardware.camera,
                limits=hardware.limits,
                tool_from_camera=hardware.tool_from_camera,
                feed=BusFeed(feeder),
                data=options.data,
                attachments=hardware.attachments,
                stage=hardware.stage,
            )
        )

        def announce(scan_id: str, document: bytes, version: Version) -> None:
            about = {"revision": version.revision, "preview": not version.exact}
            rig.announce(scan_id, "skeleton", {**about, "bytes": len(document)})

        def announce_caught_up(scan_id: str, views: int, refused: Sequence[int]) -> None:
            rig.announce(scan_id, CAUGHT_UP, {"views": views, "refused": list(refused)})

        stack.enter_context(rig)
        rig.subscribe(stack.enter_context(Broadcast(session, keys, rig.pose)).event)
        caps = SpeedCaps(
            speed_mps=hardware.limits.speed_mps,
            acceleration_mps2=hardware.limits.acceleration_mps2,
        )
        yield create_app(
            rig,
            catalogue,
            hardware.paths,
            caps,
            segmenter=hardware.segmenter,
            access=options.access,
        )


def _hardware(options: ServeOptions) -> AbstractContextManager[Hardware]:
    return simulated(options) if options.robot is None else real(options.robot)


@contextmanager
def simulated(options: ServeOptions) -> Iterator[Hardware]:
    """Give an arm behind a fake controller, and a camera that sees a grown tree."""
    simulation = prepare(options.orchard)
    with FakeUr(free_host(), time_scale=options.time_scale) as controller:
        arm = simulated_arm(controller.host)
        camera = SimCamera(lambda: arm.state().pose, simulation, scale=options.picture_scale)
        yield Hardware(
            arm=arm,
            camera=camera,
            tool_from_camera=simulation.tool_from_camera,
            limits=SIMULATED_LIMITS,
            paths=SIMULATED_PATHS,
            attachments=partial(truth_of, camera),
        )


def truth_of(camera: SimCamera, exposed_ns: Collection[int] | None) -> dict[str, bytes]:
    """Return the true skeleton and what these pictures show of it, as a file to attach.

    Nothing where some pictures were taken before this process was started: the camera of that time
    knew what they show, and a truth that did not count them would call seen wood hidden.
    """
    if exposed_ns is None:
        _log.warning("no truth is attached: an earlier life of the service took some pictures")
        return {}
    return {GROUND_TRUTH: to_json(camera.truth(exposed_ns))}


def simulated_arm(host: str) -> Arm:
    """Return the arm behind a fake controller, within the limits of the simulated cell."""
    config = Ur5Config(host=host, watchdog_hz=WATCHDOG_HZ)
    return GuardedArm(Ur5Arm(config), SIMULATED_LIMITS)


@contextmanager
def real(rig: RigFile) -> Iterator[Hardware]:
    """Give the arm and the camera that a rig file describes; nothing is opened yet."""
    limits = rig.guard()
    yield Hardware(
        arm=GuardedArm(Ur5Arm(rig.arm_config()), limits),
        camera=OakCamera(rig.camera_config()),
        tool_from_camera=rig.camera.tool_from_camera.matrix(),
        limits=limits,
        paths=rig.waypoints(),
        attachments=lambda exposed_ns: {"rig.json": rig.model_dump_json(indent=1).encode()},
        segmenter="unet",
    )


def worker_command(options: ServeOptions, endpoint: str) -> list[str]:
    """Return the command of a worker that connects to `endpoint` and ends with this process."""
    command = [sys.executable, "-m", "service.worker", "--connect", endpoint]
    return [*command, "--site", options.site, "--rig", options.rig, "--parent", str(os.getpid())]


def free_port() -> int:
    """Return a port nobody listens on; zenoh cannot tell which it was given for port 0."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
        return port
