"""The simulated stereo camera: what it sees of a scene from any pose."""

from dataclasses import dataclass, field, replace

import cv2
import numpy as np

from canopy_skel.errors import UsageError
from canopy_skel.frame import Float32Array, Intrinsics, StereoPair, UInt8Array, View
from canopy_skel.geometry import FloatArray, transform_from
from mock_hw.orchard import renderer
from mock_hw.orchard.instances import Fragments, fragments_of, instances_of
from mock_hw.orchard.mesh import Kind
from mock_hw.orchard.path import BASELINE_M, OAK_D
from mock_hw.orchard.renderer import Picture
from mock_hw.orchard.scene import Scene
from mock_hw.orchard.sensor import StereoNoise, TrueDepth, perfect_depth, stereo_depth


@dataclass(frozen=True, kw_only=True, slots=True)
class Camera:
    """The simulated stereo camera.

    noise: None = perfect depth. depth: report a depth image. pair: report the stereo pair.
    """

    intrinsics: Intrinsics = OAK_D
    baseline_m: float = BASELINE_M
    noise: StereoNoise | None = field(default_factory=StereoNoise)
    depth: bool = True
    pair: bool = False


@dataclass(frozen=True, kw_only=True, eq=False, slots=True)
class Shot:
    """A view together with what it was made from, for ground truth."""

    view: View
    picture: Picture
    fragments: Fragments


def scaled(camera: Camera, scale: float) -> Camera:
    """Return the camera with pictures of another size that show the same.

    Raises:
        UsageError: the scale leaves no picture, or is more than 1.
    """
    one = camera.intrinsics
    size_px = scale * one.width_px, scale * one.height_px
    if not (0 < scale <= 1 and min(size_px) >= 1):
        raise UsageError(
            f"no pictures scaled by {scale}; give more than 0, up to 1, that leaves a pixel"
        )
    width_px, height_px = map(round, size_px)
    across, down = width_px / one.width_px, height_px / one.height_px
    # Pixel centres are at whole numbers, so the picture's corner is at -0.5.
    return replace(
        camera,
        intrinsics=Intrinsics(
            fx_px=across * one.fx_px,
            fy_px=down * one.fy_px,
            cx_px=across * (one.cx_px + 0.5) - 0.5,
            cy_px=down * (one.cy_px + 0.5) - 0.5,
            width_px=width_px,
            height_px=height_px,
        ),
    )


def render_view(
    scene: Scene,
    base_from_camera: FloatArray,
    camera: Camera | None = None,
    *,
    index: int,
    stamp_ns: int,
    seed: int,
) -> View:
    """Return what the camera sees from any pose, with ground-truth instances.

    The same scene, pose, index and seed give the same bytes.
    """
    return shoot(
        scene, base_from_camera, camera or Camera(), index=index, stamp_ns=stamp_ns, seed=seed
    ).view


def shoot(
    scene: Scene,
    base_from_camera: FloatArray,
    camera: Camera,
    *,
    index: int,
    stamp_ns: int,
    seed: int,
) -> Shot:
    """Return a view and what it was made from; see `render_view`."""
    intrinsics = camera.intrinsics
    rng = np.random.default_rng([seed, 4, index])
    picture = renderer.draw(scene.mesh, base_from_camera, intrinsics)
    linear = renderer.radiance(scene, picture, base_from_camera, intrinsics)
    color = renderer.develop(linear, scene, rng)
    fragments = fragments_in(scene, picture, base_from_camera, intrinsics)
    instances, scores = instances_of(fragments, rng)
    right_pose = base_from_camera @ transform_from(np.eye(3), [camera.baseline_m, 0, 0])
    both = camera.depth or camera.pair
    right = renderer.draw(scene.mesh, right_pose, intrinsics) if both else picture
    view = View(
        index=index,
        stamp_ns=stamp_ns,
        color_rgb=color,
        intrinsics=intrinsics,
        base_from_camera=np.array(base_from_camera),
        depth_m=_depth(scene, picture, right, camera, rng) if camera.depth else None,
        stereo=_pair(scene, color, right, right_pose, camera, rng) if camera.pair else None,
        instances=instances,
        scores=scores,
    )
    return Shot(view=view, picture=picture, fragments=fragments)


def fragments_in(
    scene: Scene, picture: Picture, base_from_camera: FloatArray, intrinsics: Intrinsics
) -> Fragments:
    """Return the visible fragments of the scene's pieces in one picture."""
    return fragments_of(picture.vertex, scene.tree, scene.piece, base_from_camera, intrinsics)


def _depth(
    scene: Scene, left: Picture, right: Picture, camera: Camera, rng: np.random.Generator
) -> Float32Array:
    if camera.noise is None:
        return perfect_depth(left.depth_m)
    twig = (left.vertex >= 0) & (scene.tree.radius_m[left.vertex] < camera.noise.thin_m)
    true = TrueDepth(
        left_m=left.depth_m,
        right_m=right.depth_m,
        kind=left.kind,
        thin=twig | (left.kind == Kind.WIRE),
        focal_baseline=camera.intrinsics.fx_px * camera.baseline_m,
    )
    return stereo_depth(true, rng, camera.noise)


def _pair(
    scene: Scene,
    left_color: UInt8Array,
    right: Picture,
    right_pose: FloatArray,
    camera: Camera,
    rng: np.random.Generator,
) -> StereoPair:
    linear = renderer.radiance(scene, right, right_pose, camera.intrinsics)
    right_color = renderer.develop(linear, scene, rng)
    return StereoPair(
        left_mono=np.asarray(cv2.cvtColor(left_color, cv2.COLOR_RGB2GRAY), dtype=np.uint8),
        right_mono=np.asarray(cv2.cvtColor(right_color, cv2.COLOR_RGB2GRAY), dtype=np.uint8),
        intrinsics=camera.intrinsics,
        baseline_m=camera.baseline_m,
    )
