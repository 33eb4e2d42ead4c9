import numpy as np
import pytest

from canopy_skel.frame import Intrinsics
from mock_hw.orchard.light import fair_weather
from mock_hw.orchard.presets import APPLE
from mock_hw.orchard.scene import Scene, build_scene
from mock_hw.orchard.tree import Tree, grow

SMALL = Intrinsics(fx_px=220.0, fy_px=220.0, cx_px=160.0, cy_px=100.0, width_px=320, height_px=200)


@pytest.fixture(scope="session")
def small() -> Intrinsics:
    return SMALL


@pytest.fixture(scope="session")
def apple() -> Tree:
    return grow(APPLE, 3)


@pytest.fixture(scope="session")
def apple_scene(apple: Tree) -> Scene:
    return build_scene(apple, 120, fair_weather(), seed=0, rows=False, trellis=True)


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(0)
