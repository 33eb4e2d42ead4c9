"""Labelled training pictures: renders of varied trees before and behind composed clutter."""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import cv2
import numpy as np

from canopy_skel.frame import Float32Array, UInt8Array
from canopy_skel.geometry import BoolArray
from canopy_skel.segmenters.labels import LabelledImage
from mock_hw.orchard import renderer
from mock_hw.orchard.composed import clutter, varied
from mock_hw.orchard.composed.labels import labels_in
from mock_hw.orchard.light import fair_weather
from mock_hw.orchard.mesh import Int32Array, Kind
from mock_hw.orchard.presets import APPLE, OAK
from mock_hw.orchard.scene import Scene, build_scene
from mock_hw.orchard.species import Species
from mock_hw.orchard.tree import grow

FRAMES_PER_SCENE = 4
_BEHIND = (Kind.SKY, Kind.GROUND, Kind.FAR_WOOD, Kind.FAR_LEAF)
_HIDES = 0.4
_STRANGE_BARKS = ((0.42, 0.40, 0.36), (0.24, 0.11, 0.07), (0.12, 0.13, 0.09))


@dataclass(frozen=True, kw_only=True, slots=True)
class Variety:
    """What a set of pictures is drawn from.

    species: parents of all trees. strange: keep the parents' growth and leaves as they are, with
    bark and backgrounds no other set has (to validate on another kind, not only another seed).
    clutter: how many times as often as usual rows, trellis, posts and wires stand about; what is no
    branch is learnt from few pictures otherwise.
    """

    seed: int
    species: tuple[Species, ...] = (APPLE, OAK)
    strange: bool = False
    clutter: float = 1.0
    width_px: int = 960
    height_px: int = 720


def scene_frames(variety: Variety, number: int) -> Iterator[LabelledImage]:
    """Yield the `FRAMES_PER_SCENE` pictures of one scene; the same numbers give the same bytes."""
    rng = np.random.default_rng([variety.seed, number, 8])
    scene = _any_scene(rng, variety)
    spare: Float32Array | None = None
    for index in range(FRAMES_PER_SCENE):
        rng = np.random.default_rng([variety.seed, number, 9, index])
        image, spare = _frame(scene, variety, rng, spare)
        yield image


def _any_scene(rng: np.random.Generator, variety: Variety) -> Scene:
    plain = rng.random() < 0.15
    if variety.strange:
        species = variety.species[int(rng.integers(len(variety.species)))]
        if rng.random() < 0.5:
            colours = varied.any_colours(rng, _STRANGE_BARKS)
            own = species.colours
            colours = replace(own, bark=colours.bark, shoot=colours.shoot, furrow=colours.furrow)
            species = replace(species, colours=colours)
    else:
        species = varied.any_species(rng, variety.species)
    return build_scene(
        grow(species, int(rng.integers(1 << 31))),
        varied.any_leaf_count(rng, species),
        fair_weather() if plain else varied.any_light(rng),
        seed=int(rng.integers(1 << 31)),
        rows=bool(not plain and rng.random() < 0.45 * variety.clutter),
        trellis=bool(not plain and rng.random() < 0.5 * variety.clutter),
    )


def _frame(
    scene: Scene, variety: Variety, rng: np.random.Generator, spare: Float32Array | None
) -> tuple[LabelledImage, Float32Array]:
    lens = varied.any_lens(rng, variety.width_px, variety.height_px)
    pose = varied.any_pose(rng, scene.tree)
    picture = renderer.draw(scene.mesh, pose, lens)
    linear = renderer.radiance(scene, picture, pose, lens)
    untouched = linear
    vertex = picture.vertex
    if rng.random() < 0.75:
        linear, vertex = _composed(linear, picture.kind, vertex, variety, rng, spare)
    color = _photograph(linear, scene, rng)
    labels = labels_in(vertex, scene.tree, pose, lens)
    image = LabelledImage(
        color_rgb=color, instances=labels.instances, lines=labels.lines, ignore=labels.ignore
    )
    return image, untouched


def _composed(
    linear: Float32Array,
    kind: UInt8Array,
    vertex: Int32Array,
    variety: Variety,
    rng: np.random.Generator,
    spare: Float32Array | None,
) -> tuple[Float32Array, Int32Array]:
    """Change background and bark light, and put things before the tree, which hide wood."""
    size = vertex.shape[0], vertex.shape[1]
    wood: BoolArray = vertex >= 0
    if rng.random() < 0.25:
        pattern = clutter.banded(rng, size) if variety.strange else clutter.dapple(rng, size)
        shade = np.where(wood, pattern, np.float32(1))
        linear = linear * shade[..., None]
    if rng.random() < 0.65 / variety.clutter:
        behind = np.isin(kind, _BEHIND)
        level = float(np.clip(np.median(linear), 0.05, 1.0)) * float(np.exp(rng.normal(0.3, 0.5)))
        if variety.strange:
            back = clutter.strange_background(rng, size)
        else:
            back = clutter.background(rng, size, spare)
        back = back * np.float32(level / max(float(np.median(back)), 1e-3))
        edge = cv2.GaussianBlur(behind.astype(np.float32), (0, 0), 0.6)[..., None]
        share = np.where(behind[..., None], np.maximum(edge, 0.75), 0.0).astype(np.float32)
        linear = linear + share * (back - linear)
    for layer in clutter.foreground(rng, wood, variety.clutter):
        linear = layer.over(linear)
        vertex = np.where(layer.alpha > _HIDES, np.int32(-1), vertex)
    return np.asarray(linear, dtype=np.float32), vertex


def _photograph(linear: Float32Array, scene: Scene, rng: np.random.Generator) -> UInt8Array:
    """Develop a picture as cameras of any quality do."""
    sharp = rng.random() < 0.4
    blur_px = 0.45 if sharp else float(np.exp(rng.uniform(np.log(0.45), np.log(1.5))))
    light = scene.light
    if rng.random() < 0.5:
        middle = float(np.median(linear[linear.shape[0] // 6 : -linear.shape[0] // 6]))
        wanted = float(np.exp(rng.normal(np.log(0.28), 0.4)))
        exposure = float(np.clip(wanted / max(middle, 1e-3), 0.3, 8.0))
        scene = replace(scene, light=replace(light, exposure=exposure))
    color = renderer.develop(linear, scene, rng, blur_px=blur_px)
    if rng.random() < 0.1:
        color = _shaken(color, rng)
    if rng.random() < 0.25:
        noise = rng.normal(0, rng.uniform(1, 9), color.shape)
        color = np.clip(color + noise, 0, 255).astype(np.uint8)
    if rng.random() < 0.6:
        quality = int(rng.integers(35, 97))
        data = cv2.imencode(".jpg", color[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, quality])[1]
        color = np.asarray(cv2.imdecode(data, cv2.IMREAD_COLOR), dtype=np.uint8)[..., ::-1]
    return np.ascontiguousarray(color)


def _shaken(color: UInt8Array, rng: np.random.Generator) -> UInt8Array:
    """Blur along one direction, as a moving arm does."""
    reach = int(rng.integers(1, 5))
    kernel = np.zeros((2 * reach + 1, 2 * reach + 1), np.float32)
    angle = rng.uniform(0, np.pi)
    tip = np.rint(reach * np.array([np.cos(angle), np.sin(angle)])).astype(int)
    start, end = (
        (int(reach - tip[0]), int(reach - tip[1])),
        (int(reach + tip[0]), int(reach + tip[1])),
    )
    cv2.line(kernel, start, end, 1.0)
    return np.asarray(cv2.filter2D(color, -1, kernel / kernel.sum())).astype(np.uint8)
