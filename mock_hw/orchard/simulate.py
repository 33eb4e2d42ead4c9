"""A simulated scan: tree, foliage, light, camera, noise; views one by one, and the truth."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, field, replace

import numpy as np

from canopy_skel.document import SkeletonDocument
from canopy_skel.errors import UsageError
from canopy_skel.frame import View
from canopy_skel.geometry import FloatArray, invert
from mock_hw.orchard import renderer
from mock_hw.orchard.camera import Camera, Shot, fragments_in, shoot
from mock_hw.orchard.foliage import DENSITIES, FoliageFit, fit_foliage, framed
from mock_hw.orchard.light import any_weather, fair_weather
from mock_hw.orchard.path import TOOL_FROM_CAMERA, camera_path
from mock_hw.orchard.pose_noise import PoseNoise, pose_noise_named, small_transform
from mock_hw.orchard.presets import species_named
from mock_hw.orchard.scene import Scene, build_scene
from mock_hw.orchard.species import Species
from mock_hw.orchard.tree import grow
from mock_hw.orchard.truth import Seen, nothing_seen, seen_also, truth_document
from mock_hw.orchard.wind import swayed

FIRST_STAMP_NS = 1_760_000_000_000_000_000
STEP_NS = 1_500_000_000


@dataclass(frozen=True, kw_only=True, slots=True)
class Options:
    """What to simulate. Every number a scan depends on follows from these.

    topology: seed of the tree. foliage: density 1..4, or `leaf_count` leaves. noise: none,
    nominal or bad, of the poses. wind_m: reach of the loosest tip, 0 = still. weather: fair, any.
    """

    species: str = "apple"
    topology: int = 0
    foliage: int = 2
    leaf_count: int | None = None
    views: int = 10
    seed: int = 0
    noise: str = "nominal"
    wind_m: float = 0.0
    weather: str = "any"
    rows: bool = True
    camera: Camera = field(default_factory=Camera)


@dataclass(frozen=True, kw_only=True, eq=False, slots=True)
class Simulation:
    """A scan that is ready to run.

    true_poses: `base_from_camera` (4, 4) at which the pictures are taken; reported_poses: what
    the arm and the hand-eye calibration say; tool_from_camera: that calibration, with its error.
    fit: how the leaf count was found, None where it was given.
    """

    options: Options
    scene: Scene
    fit: FoliageFit | None
    true_poses: tuple[FloatArray, ...]
    reported_poses: tuple[FloatArray, ...]
    tool_from_camera: FloatArray

    @property
    def scan_id(self) -> str:
        """The name of the scan."""
        o = self.options
        leaves = f"fd{o.foliage}" if o.leaf_count is None else f"{o.leaf_count}leaves"
        return f"{o.species}_{o.topology:03d}_{leaves}_{o.views}views_seed{o.seed}"

    def manifest(self) -> dict[str, object]:
        """Return everything needed to make this scan again, and how dense its foliage is."""
        return {
            "scan_id": self.scan_id,
            "options": asdict(self.options),
            "leaf_count": self.scene.leaf_count,
            "v_det": None if self.fit is None else self.fit.v_det,
            "v_det_target": None if self.fit is None else self.fit.target,
        }


def prepare(options: Options, fit: FoliageFit | None = None) -> Simulation:
    """Grow the tree, hang the leaves and draw all noise that lasts for the scan.

    `fit` spares the bisection where the leaf count of the density is known already.

    Raises:
        UsageError: an option is unknown or negative.
    """
    require_known(options)
    species = species_named(options.species)
    noise = pose_noise_named(options.noise)
    true_poses = camera_path(options.views)
    tree = grow(species, options.topology)
    trellis = trellised(species)
    surroundings_seed = options.topology
    leaf_count = options.leaf_count
    if leaf_count is None:
        fit = (
            fit or fit_foliage(tree, (options.foliage,), seed=surroundings_seed, trellis=trellis)[0]
        )
        leaf_count = fit.leaf_count
    light = any_weather(_rng(options, 0)) if options.weather == "any" else fair_weather()
    scene = build_scene(
        tree, leaf_count, light, seed=surroundings_seed, rows=options.rows, trellis=trellis
    )
    tool_from_camera, reported = _reported(true_poses, noise, _rng(options, 1))
    return Simulation(
        options=options,
        scene=scene,
        fit=fit if options.leaf_count is None else None,
        true_poses=tuple(true_poses),
        reported_poses=reported,
        tool_from_camera=tool_from_camera,
    )


def require_known(options: Options) -> None:
    """Check that a scan can be simulated as asked, before any work is done.

    Raises:
        UsageError: an option is unknown or negative.
    """
    for name in ("topology", "seed", "leaf_count", "wind_m"):
        value = getattr(options, name)
        if value is not None and not 0 <= value < math.inf:
            raise UsageError(f"{name} is {value}; give 0 or more")
    if options.foliage not in DENSITIES:
        raise UsageError(f"no foliage density {options.foliage}; choose 1, 2, 3 or 4")
    if options.weather not in ("fair", "any"):
        raise UsageError(f"unknown weather {options.weather!r}; choose fair or any")
    species_named(options.species)
    pose_noise_named(options.noise)
    camera_path(options.views)


def fit_densities(species: str, topology: int, densities: Sequence[int]) -> tuple[FoliageFit, ...]:
    """Return the leaf counts of several foliage densities of one tree, which is drawn once.

    Raises:
        UsageError: there is no such species or density.
    """
    kind = species_named(species)
    return fit_foliage(grow(kind, topology), densities, seed=topology, trellis=trellised(kind))


def _reported(
    true_poses: list[FloatArray], noise: PoseNoise, rng: np.random.Generator
) -> tuple[FloatArray, tuple[FloatArray, ...]]:
    """Return the hand-eye calibration the rig believes in, and the camera poses it reports."""
    tool_from_camera = TOOL_FROM_CAMERA @ small_transform(rng, noise.hand_eye_m, noise.hand_eye_deg)
    poses = []
    for pose in true_poses:
        drift = small_transform(rng, noise.view_m, noise.view_deg)
        poses.append(pose @ invert(TOOL_FROM_CAMERA) @ drift @ tool_from_camera)
    return tool_from_camera, tuple(poses)


def trellised(species: Species) -> bool:
    """Say whether a species is grown on posts and wires."""
    return species.name == "apple"


def views(simulation: Simulation) -> Iterator[View]:
    """Yield the views of the scan as the method gets them: noisy depth, reported poses."""
    for shot in shots(simulation):
        yield shot.view


def shots(simulation: Simulation) -> Iterator[Shot]:
    """Yield the views of the scan, each with what it was made from."""
    for index, pose in enumerate(simulation.true_poses):
        shot = shoot(
            scene_at(simulation, index),
            pose,
            simulation.options.camera,
            index=index,
            stamp_ns=FIRST_STAMP_NS + index * STEP_NS,
            seed=simulation.options.seed,
        )
        reported = replace(shot.view, base_from_camera=simulation.reported_poses[index])
        yield replace(shot, view=reported)


def truth(simulation: Simulation) -> SkeletonDocument:
    """Return the true skeleton, with what the views of this scan show of it."""
    intrinsics, tree = simulation.options.camera.intrinsics, simulation.scene.tree
    seen = nothing_seen(tree)
    for index, pose in enumerate(simulation.true_poses):
        scene = scene_at(simulation, index)
        picture = renderer.draw(scene.mesh, pose, intrinsics)
        seen = seen_also(seen, picture.vertex, fragments_in(scene, picture, pose, intrinsics))
    return truth_of(simulation, seen)


def truth_of(simulation: Simulation, seen: Seen) -> SkeletonDocument:
    """Return the true skeleton, with what all views of this scan were found to show of it."""
    intrinsics, tree = simulation.options.camera.intrinsics, simulation.scene.tree
    return truth_document(
        tree,
        seen,
        framed(tree, list(simulation.true_poses), intrinsics),
        scan_id=simulation.scan_id,
        views=len(simulation.true_poses),
    )


def _rng(options: Options, purpose: int) -> np.random.Generator:
    return np.random.default_rng([options.seed, options.topology, 5, purpose])


def scene_at(simulation: Simulation, index: int) -> Scene:
    """Return the scene as the wind has it at view `index`."""
    scene, reach = simulation.scene, simulation.options.wind_m
    if reach == 0:
        return scene
    rng = np.random.default_rng([simulation.options.seed, 6, index])
    return replace(scene, mesh=swayed(scene.mesh, scene.tree, reach, rng))
