"""Trees, weather and lenses drawn far more widely than any orchard has them.

A network that has seen only our presets would know our presets; what varies here is what must not
matter: growth, leaf shape, colours of bark and leaf, light, distance, roll.
"""

from dataclasses import replace

import numpy as np

from canopy_skel.frame import Intrinsics
from canopy_skel.geometry import FloatArray, transform_from
from mock_hw.orchard.foliage import MOST_LEAVES
from mock_hw.orchard.light import Light, any_weather
from mock_hw.orchard.path import look_at
from mock_hw.orchard.species import Colours, FruitShape, Growth, LeafShape, Range, Rgb, Species
from mock_hw.orchard.tree import Tree

_BARKS: tuple[Rgb, ...] = (
    (0.20, 0.155, 0.125),
    (0.155, 0.135, 0.115),
    (0.09, 0.075, 0.065),
    (0.17, 0.09, 0.06),
    (0.28, 0.25, 0.21),
    (0.06, 0.06, 0.06),
    (0.22, 0.17, 0.10),
)
_DISTANCE_M = (0.3, 1.6)
_FOCAL = (0.55, 1.30)
_WIDE_LEAF_M = 0.065


def any_species(rng: np.random.Generator, parents: tuple[Species, ...]) -> Species:
    """Draw a species near one of `parents`, with leaves, fruit and colours of its own."""
    parent = parents[int(rng.integers(len(parents)))]
    stout = float(np.exp(rng.normal(-0.05, 0.25)))
    low, high = parent.trunk_radius_m
    strange = rng.random() < 0.6
    return replace(
        parent,
        trunk_radius_m=(low * stout, high * stout * 1.25),
        tip_radius_m=parent.tip_radius_m * float(rng.uniform(0.7, 1.3)),
        lean_deg=float(rng.uniform(0, 14)),
        orders=tuple(_any_growth(rng, growth, stout) for growth in parent.orders),
        leaf=_any_leaf(rng, parent.leaf) if strange else parent.leaf,
        fruit=_any_fruit(rng),
        colours=any_colours(rng, _BARKS),
    )


def _any_growth(rng: np.random.Generator, growth: Growth, stout: float) -> Growth:
    longer = float(rng.uniform(0.8, 1.15))
    first, middle, last = growth.length_m
    turn = rng.normal(0, 7)
    low, mid, high = growth.angle_deg
    return replace(
        growth,
        per_metre=growth.per_metre * float(rng.uniform(0.5, 1.25)),
        length_m=(first * longer, middle * longer, last * longer),
        angle_deg=(low + turn, mid + turn, high + turn) if mid else growth.angle_deg,
        rise=growth.rise * float(rng.uniform(-0.2, 1.6)),
        crook_deg=growth.crook_deg * float(rng.uniform(0.5, 1.6)),
        stoutness=growth.stoutness * float(rng.uniform(0.7, 1.3)),
        taper=float(np.clip(growth.taper * rng.uniform(0.7, 1.2), 0.25, 1.0)),
    )


def _any_leaf(rng: np.random.Generator, leaf: LeafShape) -> LeafShape:
    """Draw a leaf outline, simple or pinnate, and how leaves sit and hang."""
    stations = np.linspace(0, 1, int(rng.integers(5, 11)))
    fullest, point = rng.uniform(0.6, 1.6), rng.uniform(0.6, 1.5)
    width = rng.uniform(0.08, 0.5) * np.sin(np.pi * stations**fullest) ** point
    if rng.random() < 0.3:
        width[1:-1:2] *= rng.uniform(0.45, 0.9)
    width[[0, -1]] = 0.0
    leaflets = int(rng.choice([1, 1, 1, 1, 3, 5, 9]))
    length = float(np.exp(rng.uniform(np.log(0.03), np.log(0.12))))
    if leaflets > 1:
        length *= 2.2
    return replace(
        leaf,
        stations=tuple(stations.tolist()),
        half_width=tuple(width.tolist()),
        length_m=(0.75 * length, 1.3 * length),
        petiole_m=_stretch(leaf.petiole_m, float(rng.uniform(0.5, 1.8))),
        leaflets=leaflets,
        cluster=int(rng.integers(1, 7)),
        tip_bias=float(rng.uniform(0.0, 2.0)),
        droop=float(rng.uniform(0.0, 0.7)),
        curl=(0.0, float(rng.uniform(0.1, 0.7))),
        fold=(0.0, float(rng.uniform(0.1, 0.6))),
    )


def _stretch(span: Range, factor: float) -> Range:
    return span[0] * factor, span[1] * factor


def _any_fruit(rng: np.random.Generator) -> FruitShape | None:
    if rng.random() < 0.45:
        return None
    radius = float(np.exp(rng.uniform(np.log(0.008), np.log(0.042))))
    return FruitShape(
        radius_m=(0.85 * radius, 1.15 * radius),
        stalk_m=float(rng.uniform(0.01, 0.04)),
        count=int(rng.integers(3, 60)),
        flatness=float(rng.uniform(0.8, 1.2)),
    )


def any_colours(rng: np.random.Generator, barks: tuple[Rgb, ...]) -> Colours:
    """Draw colours around given barks; leaves are green with a chance of yellow, red or pale."""
    shift = np.exp(rng.normal(0, 0.08, 3)) * np.exp(rng.normal(0, 0.3))
    bark = np.clip(np.array(barks[int(rng.integers(len(barks)))]) * shift, 0.015, 0.6)
    shoot = bark * rng.uniform(0.6, 1.1) * np.exp(rng.normal(0, 0.12, 3))
    if rng.random() < 0.2:
        shoot = np.array([0.11, 0.14, 0.05]) * rng.uniform(0.6, 1.3)
    autumn = rng.random()
    tint = np.array([1.0, 1.0, 1.0])
    if autumn < 0.08:
        tint = np.array([3.5, 1.2, 1.0]) if autumn < 0.04 else np.array([5.0, 0.8, 1.2])
    deep = np.exp(rng.normal(0, 0.3)) * np.exp(rng.normal(0, 0.12, 3)) * tint
    above = np.array([0.048, 0.115, 0.02]) * deep
    fruit = rng.uniform(0.02, 0.5, 3)
    return Colours(
        bark=_rgb(bark),
        shoot=_rgb(shoot),
        leaf_above=_rgb(above),
        leaf_below=_rgb(above * rng.uniform([1.5, 1.2, 2.0], [3.0, 1.9, 5.0])),
        leaf_through=_rgb(np.array([0.18, 0.30, 0.03]) * np.sqrt(deep) * rng.uniform(0.5, 1.2)),
        fruit=_rgb(fruit),
        fruit_cheek=_rgb(np.clip(fruit * rng.uniform(0.3, 2.0, 3), 0.01, 0.6)),
        furrow=float(rng.uniform(0.1, 0.9)),
    )


def _rgb(values: FloatArray) -> Rgb:
    r, g, b = (float(value) for value in np.clip(values, 0.002, 0.9))
    return r, g, b


def any_leaf_count(rng: np.random.Generator, species: Species) -> int:
    """Draw from bare to dense; small leaves come in larger numbers."""
    if rng.random() < 0.1:
        return 0
    size = float(np.mean(species.leaf.length_m)) / np.sqrt(species.leaf.leaflets)
    most = MOST_LEAVES["apple"] * min((_WIDE_LEAF_M / size) ** 1.6, 1.6)
    return int(most * 0.65 * rng.random() ** 1.6)


def any_light(rng: np.random.Generator) -> Light:
    """Draw weather, a sun behind the tree (silhouettes), or a lamp at night."""
    light = any_weather(rng)
    luck = rng.random()
    if luck < 0.12:
        return replace(
            light,
            sun_azimuth_deg=float(rng.uniform(-45, 45)),
            exposure=light.exposure * float(rng.uniform(0.7, 1.5)),
        )
    if luck < 0.26:
        night = float(np.exp(rng.uniform(np.log(0.01), np.log(0.25))))
        return replace(
            light,
            sun=_dimmed(light.sun, night),
            sky=_dimmed(light.sky, night),
            horizon=_dimmed(light.horizon, night),
            flash=float(rng.uniform(1.5, 5.0)),
            exposure=float(rng.uniform(0.8, 2.0)),
        )
    return light


def _dimmed(rgb: Rgb, factor: float) -> Rgb:
    return rgb[0] * factor, rgb[1] * factor, rgb[2] * factor


def any_lens(rng: np.random.Generator, width_px: int, height_px: int) -> Intrinsics:
    """Draw a focal length between a wide and a narrow machine-vision lens."""
    focal = width_px * float(np.exp(rng.uniform(*np.log(_FOCAL))))
    return Intrinsics(
        fx_px=focal,
        fy_px=focal,
        cx_px=(width_px - 1) / 2,
        cy_px=(height_px - 1) / 2,
        width_px=width_px,
        height_px=height_px,
    )


def any_pose(rng: np.random.Generator, tree: Tree) -> FloatArray:
    """Draw a camera 0.3 to 1.6 m before some wood of the tree, stout wood preferred."""
    weight = np.sqrt(tree.radius_m) / np.sqrt(tree.radius_m).sum()
    aim = tree.position[int(rng.choice(len(weight), p=weight))] + rng.normal(0, 0.08, 3)
    bearing, climb = rng.uniform(-0.8, 0.8), rng.uniform(-0.5, 0.5)
    ahead = np.array([np.cos(bearing) * np.cos(climb), np.sin(bearing), np.sin(climb)])
    near, far = _DISTANCE_M
    eye = aim - (near + (far - near) * np.sqrt(rng.random())) * ahead
    eye[2] = max(eye[2], -0.75)
    roll = rng.uniform(-np.pi, np.pi) if rng.random() < 0.25 else rng.normal(0, 0.1)
    c, s = np.cos(roll), np.sin(roll)
    turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    return look_at(eye, aim) @ transform_from(turn, [0.0, 0.0, 0.0])
