"""Labelled pictures to train a branch segmenter on: tree, tints, light and camera drawn anew."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from canopy_skel.frame import UInt8Array
from canopy_skel.geometry import BoolArray, FloatArray, transform_from
from mock_hw.orchard.camera import Camera, Shot, shoot
from mock_hw.orchard.foliage import MOST_LEAVES
from mock_hw.orchard.kernels import texture
from mock_hw.orchard.light import any_weather
from mock_hw.orchard.path import look_at
from mock_hw.orchard.presets import SPECIES
from mock_hw.orchard.scene import Scene, build_scene
from mock_hw.orchard.tree import TRUNK_X_M, grow

FRAMES_PER_SCENE = 4
_SHADE, _TINT, _BRIGHTEST = 0.25, 0.12, 0.6
FIRST_FITTING_TOPOLOGY = 100
"""Trees from here on are for training and fitting; those before it are for experiments."""


@dataclass(frozen=True, kw_only=True, eq=False, slots=True)
class Frame:
    """One training image: color_rgb (H, W, 3), the instance masks, their scores, what to ignore.

    topology: the tree in it, `FIRST_FITTING_TOPOLOGY` or later.
    """

    color_rgb: UInt8Array
    masks: list[BoolArray]
    scores: tuple[float, ...]
    ignore: BoolArray
    species: str
    topology: int
    leaf_count: int


def scene_frames(
    number: int, *, seed: int, species: Sequence[str] = tuple(SPECIES), camera: Camera | None = None
) -> Iterator[Frame]:
    """Yield the frames of scene `number`; the same arguments give the same frames.

    Frame k of scene n is frame n * `FRAMES_PER_SCENE` + k of all.
    """
    lens = replace(camera or Camera(), depth=False, pair=False)
    rng = np.random.default_rng([seed, number, 8])
    topology = int(rng.integers(FIRST_FITTING_TOPOLOGY, 1 << 31))
    scene = _any_scene(str(rng.choice(sorted(species))), topology, rng)
    for index in range(number * FRAMES_PER_SCENE, (number + 1) * FRAMES_PER_SCENE):
        pose = _any_pose(np.random.default_rng([seed, index, 9]))
        yield _frame(shoot(scene, pose, lens, index=index, stamp_ns=0, seed=seed), scene, topology)


def _any_scene(name: str, topology: int, rng: np.random.Generator) -> Scene:
    scene = build_scene(
        grow(SPECIES[name], topology),
        int(MOST_LEAVES[name] * 0.7 * rng.random() ** 2),
        any_weather(rng),
        seed=int(rng.integers(1 << 31)),
        rows=bool(rng.random() < 0.8),
        trellis=bool(rng.random() < 0.5),
    )
    return replace(scene, palette=_tinted(scene.palette, rng))


def _tinted(palette: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Draw other tints of bark, leaves, fruit, ground and hedge; the light stays as it is."""
    shade = rng.normal(0, _SHADE, (len(palette), 1)) + rng.normal(0, _TINT, palette.shape)
    lit = [texture.SUN, texture.SKY, texture.HORIZON]
    shade[lit] = 0
    return np.asarray(np.minimum(palette * np.exp(shade), np.maximum(palette, _BRIGHTEST)))


def _any_pose(rng: np.random.Generator) -> FloatArray:
    """Draw a camera 0.35 to 1.6 m before a point of the crown, upright or turned."""
    target = np.array([TRUNK_X_M, 0.0, 0.05]) + rng.normal(0, [0.1, 0.25, 0.3])
    bearing, climb = rng.uniform(-0.7, 0.7), rng.uniform(-0.45, 0.45)
    ahead = np.array([np.cos(bearing) * np.cos(climb), np.sin(bearing), np.sin(climb)])
    pose = look_at(target - rng.uniform(0.35, 1.6) * ahead, target)
    roll = rng.uniform(-np.pi, np.pi) if rng.random() < 0.3 else rng.normal(0, 0.08)
    c, s = np.cos(roll), np.sin(roll)
    turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    return pose @ transform_from(turn, [0.0, 0.0, 0.0])


def _frame(shot: Shot, scene: Scene, topology: int) -> Frame:
    instances, scores = shot.view.instances, shot.view.scores
    if instances is None or scores is None:
        raise ValueError("the camera labels every view")
    return Frame(
        color_rgb=shot.view.color_rgb,
        masks=[instances == number for number in range(1, len(scores) + 1)],
        scores=scores,
        ignore=(shot.fragments.label >= 0) & (instances == 0),
        species=scene.tree.species.name,
        topology=topology,
        leaf_count=scene.leaf_count,
    )
