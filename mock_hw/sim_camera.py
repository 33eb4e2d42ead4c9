"""A camera that sees the synthetic orchard from wherever the arm has carried it."""

import time
from collections.abc import Callable, Collection
from concurrent.futures import CancelledError, Future, ThreadPoolExecutor
from concurrent.futures import TimeoutError as FutureTimeoutError
from dataclasses import dataclass, replace
from types import TracebackType
from typing import Self

import numpy as np

from canopy_skel.document import SkeletonDocument
from canopy_skel.frame import Intrinsics
from canopy_skel.geometry import FloatArray, invert
from drivers.errors import CameraTimeoutError, NoCameraError
from drivers.protocols import CameraImage, ToolPose
from mock_hw.orchard.camera import Shot, scaled, shoot
from mock_hw.orchard.foliage import framed
from mock_hw.orchard.path import TOOL_FROM_CAMERA
from mock_hw.orchard.pose_noise import pose_noise_named, small_transform
from mock_hw.orchard.simulate import Simulation, scene_at
from mock_hw.orchard.truth import Seen, nothing_seen, seen_also, seen_together, truth_document

_POLL_S = 0.001
_WARM_UP = Intrinsics(fx_px=9.0, fy_px=9.0, cx_px=8.0, cy_px=5.0, width_px=16, height_px=10)


@dataclass(frozen=True, kw_only=True, eq=False, slots=True)
class Exposure:
    """One exposure: when, from where in truth (`base_from_camera`), and what it shows."""

    stamp_ns: int
    base_from_camera: FloatArray
    seen: Seen


class SimCamera:
    """The simulated stereo camera on an arm; see `drivers.protocols.Camera`.

    The picture is of the instant at which the arm measured its pose, through the true hand-eye
    transform and with the error the simulation gives every pose; it is returned when it is drawn,
    about 1.5 s of computing later at full size, in a thread of its own. The same pose, exposure
    number and simulation give the same picture.

    Args:
        arm_pose: returns the newest measured pose of the flange.
        simulation: tree, light, noise and camera; its own path is not used.
        scale: size of the picture in proportion to the simulated camera's, which draws faster.

    Raises:
        UsageError: the scale leaves no picture.
    """

    def __init__(
        self, arm_pose: Callable[[], ToolPose], simulation: Simulation, *, scale: float = 1.0
    ) -> None:
        self._arm_pose = arm_pose
        self._simulation = simulation
        self._camera = scaled(simulation.options.camera, scale)
        self._noise = pose_noise_named(simulation.options.noise)
        self._studio: ThreadPoolExecutor | None = None
        self._grabs = 0
        self._newest_ns = 0
        self._exposures: list[Exposure] = []

    def __enter__(self) -> Self:
        """Compile what draws, so that the first picture comes as fast as the others."""
        tiny = replace(self._camera, intrinsics=_WARM_UP)
        shoot(self._simulation.scene, np.eye(4), tiny, index=0, stamp_ns=0, seed=0)
        self._studio = ThreadPoolExecutor(1, thread_name_prefix="sim-camera")
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        """Finish what is being drawn."""
        studio, self._studio = self._studio, None
        if studio is not None:
            studio.shutdown(cancel_futures=True)

    @property
    def exposures(self) -> tuple[Exposure, ...]:
        """All pictures drawn so far, retakes included, in order."""
        return tuple(self._exposures)

    def check(self) -> None:
        """Raise NoCameraError outside the `with` block."""
        self._open_studio()

    def grab(self, timeout_s: float) -> CameraImage:
        """Return what is seen from the first pose measured after this call; see `Camera.grab`."""
        studio = self._open_studio()
        until_s = time.perf_counter() + timeout_s
        pose = self._pose_after(time.monotonic_ns(), until_s)
        index, self._grabs = self._grabs, self._grabs + 1
        drawn: Future[CameraImage] = studio.submit(self._expose, pose, index)
        try:
            return drawn.result(max(0.0, until_s - time.perf_counter()))
        except FutureTimeoutError as error:
            raise CameraTimeoutError(
                f"the picture was not drawn within {timeout_s} s; allow more time or a smaller size"
            ) from error
        except CancelledError as error:
            raise NoCameraError("the camera was closed before the picture was drawn") from error

    def truth(self, stamps_ns: Collection[int] | None = None) -> SkeletonDocument:
        """Return the true skeleton and what the exposures (with these stamps; all) show of it."""
        kept = [one for one in self._exposures if stamps_ns is None or one.stamp_ns in stamps_ns]
        tree = self._simulation.scene.tree
        poses = [one.base_from_camera for one in kept]
        return truth_document(
            tree,
            seen_together((one.seen for one in kept), tree),
            framed(tree, poses, self._camera.intrinsics),
            scan_id=self._simulation.scan_id,
            views=len(kept),
        )

    def _open_studio(self) -> ThreadPoolExecutor:
        studio = self._studio
        if studio is None:
            raise NoCameraError("the camera is not open: use it inside its `with` block")
        return studio

    def _pose_after(self, called_ns: int, until_s: float) -> ToolPose:
        """Wait for a measurement that is newer than the call and than the last exposure."""
        while True:
            pose = self._arm_pose()
            if pose.stamp_ns > max(called_ns, self._newest_ns):
                self._newest_ns = pose.stamp_ns
                return pose
            if time.perf_counter() > until_s:
                raise CameraTimeoutError("the arm has not said in time where the camera is")
            time.sleep(_POLL_S)

    def _expose(self, pose: ToolPose, index: int) -> CameraImage:
        options = self._simulation.options
        rng = np.random.default_rng([options.seed, options.topology, 8, index])
        error = small_transform(rng, self._noise.view_m, self._noise.view_deg)
        base_from_camera = pose.base_from_tool0 @ invert(error) @ TOOL_FROM_CAMERA
        shot = shoot(
            scene_at(self._simulation, index),
            base_from_camera,
            self._camera,
            index=index,
            stamp_ns=pose.stamp_ns,
            seed=options.seed,
        )
        tree = self._simulation.scene.tree
        seen = seen_also(nothing_seen(tree), shot.picture.vertex, shot.fragments)
        self._exposures.append(
            Exposure(stamp_ns=pose.stamp_ns, base_from_camera=base_from_camera, seen=seen)
        )
        return _image(shot)


def _image(shot: Shot) -> CameraImage:
    view = shot.view
    return CameraImage(
        stamp_ns=view.stamp_ns,
        color_rgb=view.color_rgb,
        intrinsics=view.intrinsics,
        depth_m=view.depth_m,
        stereo=view.stereo,
        instances=view.instances,
        scores=view.scores,
    )
