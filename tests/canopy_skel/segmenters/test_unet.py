import os
import subprocess
import sys
from dataclasses import replace
from math import ceil
from pathlib import Path

import numpy as np
import pytest
import torch
from contracts.segmenter import SegmenterContract
from scenes.scorers import constant_scorer
from scenes.views import view_of

from canopy_skel.errors import UsageError, ViewError
from canopy_skel.recording import read_recording
from canopy_skel.segmenters.unet import segmenter as module
from canopy_skel.segmenters.unet.grouping import Grouping, Strands
from canopy_skel.segmenters.unet.network import UNet
from canopy_skel.segmenters.unet.portable import PortableNetwork
from canopy_skel.segmenters.unet.precision import has_fast_bfloat16
from canopy_skel.segmenters.unet.segmenter import UNetSegmenter, masks_of
from canopy_skel.segmenters.unet.weights import Model, load

DEMO = Path(__file__).parents[3] / "recordings/demo_apple.mcap"
TORCH_FREE = """
import sys
import canopy_skel.pipeline, canopy_skel.recording, canopy_skel.segmenters.recorded
import canopy_skel.segmenters.labels, canopy_skel.segmenters.unet.grouping
import canopy_skel.segmenters.unet.targets, canopy_skel.metrics.segmentation
import canopy_skel.segmenters.mapping, canopy_skel.segmenters.unet.portable
canopy_skel.segmenters.unet.portable.PortableNetwork()
import service.cli, service.replay, service.worker, service.compose, service.skeletons
service.skeletons.SEGMENTERS["recorded"]()
print("torch" in sys.modules)
"""


ONE_CORE = """
import os, sys, time
from pathlib import Path
from canopy_skel.recording import read_recording
from canopy_skel.segmenters.unet.segmenter import UNetSegmenter
from canopy_skel.segmenters.unet.weights import load
import torch
view = next(iter(read_recording(Path(sys.argv[1])).views()))
segmenter = UNetSegmenter(load())
segmenter.segment(view)
wall_s, cpu_s = time.perf_counter(), time.process_time()
for _ in range(3):
    segmenter.segment(view)
wall_s, cpu_s = time.perf_counter() - wall_s, time.process_time() - cpu_s
print(torch.get_num_threads(), os.environ["OMP_WAIT_POLICY"], cpu_s <= 1.2 * wall_s)
"""


@pytest.fixture(scope="module")
def untrained():
    torch.manual_seed(4)
    channels = (8, 8, 8)
    return Model(
        network=UNet(channels).eval(),
        channels=channels,
        zoom=1.0,
        grouping=Grouping(),
        scorer=constant_scorer(channels, 0.0),
        least_score=0.0,
    )


def noise(height, width):
    return np.random.default_rng(1).integers(0, 256, (height, width, 3)).astype(np.uint8)


@pytest.fixture(scope="module")
def builtin():
    return UNetSegmenter(load())


class TestUNetSegmenter(SegmenterContract):
    @pytest.fixture
    def segmenter(self, builtin):
        return builtin

    @pytest.fixture
    def view_with_branches(self):
        return next(iter(read_recording(DEMO).views()))

    @pytest.fixture
    def empty_view(self):
        return view_of(np.full((200, 300, 3), 180, np.uint8))


def test_only_the_learned_segmenter_loads_torch():
    done = subprocess.run(
        [sys.executable, "-c", TORCH_FREE], capture_output=True, text=True, check=True
    )
    assert done.stdout.strip() == "False"


def test_segmenting_keeps_to_one_core_however_many_there_are():
    free = {name: value for name, value in os.environ.items() if not name.startswith("OMP_")}
    done = subprocess.run(
        [sys.executable, "-c", ONE_CORE, str(DEMO)],
        capture_output=True,
        text=True,
        check=True,
        env=free,
    )
    assert done.stdout.split() == ["1", "PASSIVE", "True"]


@pytest.mark.parametrize("zoom", [1.0, 1.25, 0.5])
@pytest.mark.parametrize("size", [(1, 1), (3, 500), (97, 131), (64, 64)])
def test_pictures_of_any_size_are_known_at_half_of_it_enlarged(untrained, size, zoom):
    known = UNetSegmenter(replace(untrained, zoom=zoom)).known(noise(*size))
    grid = ceil(size[0] * zoom / 2), ceil(size[1] * zoom / 2)
    assert known.maps.shape == (8, *grid)
    assert known.features.shape == (untrained.channels[0], *grid)
    assert all(np.isfinite(part).all() for part in known)


@pytest.mark.parametrize("size", [(1, 1), (31, 500), (240, 320)])
def test_without_torch_the_built_in_network_says_the_same(builtin, size):
    expected = builtin.known(noise(*size)).maps
    maps = PortableNetwork().maps(noise(*size))
    assert maps.shape == expected.shape
    assert np.allclose(maps, expected, atol=1e-3)


def test_an_instance_that_fills_the_picture_covers_all_of_any_size():
    for size in range(1, 300):
        grid = ceil(1.25 * size / 2)
        strands = Strands(
            label=np.ones((grid, grid), np.int32),
            surplus=np.ones((grid, grid), np.float32),
            log_radius=np.zeros((grid, grid), np.float32),
        )
        (mask,) = masks_of(strands, np.ones(1), (size, size), least_score=0.0)
        assert (mask.top_px, mask.left_px, mask.mask.shape) == (0, 0, (size, size))
        assert mask.mask.all()


@pytest.mark.parametrize("zoom", [0.7, 1.0, 1.25])
def test_instances_are_outlined_in_the_picture_whatever_the_grid(zoom):
    height, width = 75, 111
    grid = ceil(height * zoom / 2), ceil(width * zoom / 2)
    label = np.zeros(grid, np.int32)
    middle = grid[1] // 2
    label[:, 2:middle], label[:, middle:-2] = 1, 2
    surplus = np.ones(grid, np.float32)
    surplus[: grid[0] // 2] = -1
    log_radius = np.where(label == 1, np.float32(np.log(3.0)), np.float32(np.log(5.0)))
    strands = Strands(label=label, surplus=surplus, log_radius=log_radius)
    masks = masks_of(strands, np.array([0.4, 0.9]), (height, width), least_score=0.0)
    shown = np.zeros((height, width), int)
    for mask in masks:
        rows, columns = mask.mask.shape
        box = np.s_[mask.top_px : mask.top_px + rows, mask.left_px : mask.left_px + columns]
        assert shown[box].shape == mask.mask.shape
        shown[box] += mask.mask
    cell_px = np.array([height, width]) / grid
    assert [mask.radius_px for mask in masks] == pytest.approx(cell_px.mean() * np.array([3, 5]))
    v, u = np.mgrid[:height, :width] + 0.5
    inside = (u > 2 * cell_px[1]) & (u < (grid[1] - 2) * cell_px[1])
    edge = abs(v - (grid[0] // 2) * cell_px[0]) < 1
    assert shown.max() == 1
    assert np.array_equal((shown > 0) & ~edge, inside & (v > (grid[0] // 2) * cell_px[0]) & ~edge)
    assert [mask.confidence for mask in masks] == [0.4, 0.9]


def assert_same(one, other):
    for part, expected in zip(one, other, strict=True):
        assert np.allclose(part, expected, atol=1e-4)


def test_tiles_fit_together_without_a_seam(untrained):
    picture = noise(500, 700)
    whole = UNetSegmenter(untrained).known(picture)
    tiled = UNetSegmenter(untrained, tile_px=320).known(picture)
    assert_same(whole, tiled)


def test_where_memory_runs_out_tiles_are_made_smaller(untrained, monkeypatch):
    picture = noise(300, 1300)
    segmenter = UNetSegmenter(untrained)
    whole = segmenter.known(picture)
    infer = UNetSegmenter._infer
    seen = []

    def scarce(self, color):
        seen.append(color.shape[1])
        if color.shape[1] > 800:
            raise RuntimeError("DefaultCPUAllocator: can't allocate memory: you tried 9 bytes")
        return infer(self, color)

    monkeypatch.setattr(UNetSegmenter, "_infer", scarce)
    assert_same(segmenter.known(picture), whole)
    assert max(seen) > 800
    assert min(seen) <= 768


def test_where_no_memory_is_left_at_all_the_view_is_refused(untrained, monkeypatch):
    def none_left(self, color):
        raise MemoryError

    monkeypatch.setattr(UNetSegmenter, "_infer", none_left)
    with pytest.raises(ViewError, match="view 3: no memory left for a picture of 80x60"):
        UNetSegmenter(untrained).segment(view_of(noise(60, 80)))


def test_other_errors_are_not_taken_for_lack_of_memory(untrained, monkeypatch):
    def broken(self, color):
        raise RuntimeError("a bug")

    monkeypatch.setattr(UNetSegmenter, "_infer", broken)
    with pytest.raises(RuntimeError, match="a bug"):
        UNetSegmenter(untrained).known(noise(60, 80))


@pytest.mark.parametrize("color", [np.zeros((40, 60, 3), np.uint16), np.zeros((40, 60), np.uint8)])
def test_pictures_that_are_not_8_bit_colour_are_refused(untrained, color):
    with pytest.raises(ViewError, match=r"needs \(H, W, 3\) uint8"):
        UNetSegmenter(untrained).segment(view_of(color))


def test_instances_below_the_least_score_are_not_reported(untrained):
    view = view_of(noise(200, 300))
    loose = replace(untrained, grouping=Grouping(outline=0.4, least_pixels=8, least_length_px=2))
    assert len(UNetSegmenter(loose).segment(view)) > 0
    assert UNetSegmenter(replace(loose, least_score=0.6)).segment(view) == []


def test_the_number_of_threads_is_bounded(untrained):
    UNetSegmenter(untrained)
    assert torch.get_num_threads() == 1


@pytest.mark.skipif(not has_fast_bfloat16(), reason="this CPU has no bfloat16 arithmetic")
def test_bfloat16_says_nearly_the_same(untrained):
    picture = noise(200, 300)
    both = [UNetSegmenter(untrained, bfloat16=fast).known(picture) for fast in (False, True)]
    for exact, rough in zip(*both, strict=True):
        assert np.abs(exact - rough).mean() < 0.05 * np.abs(exact).mean()
        assert not np.array_equal(exact, rough)


def test_bfloat16_is_refused_where_the_cpu_lacks_it(untrained, monkeypatch):
    monkeypatch.setattr(module, "has_fast_bfloat16", lambda: False)
    with pytest.raises(UsageError, match="no bfloat16"):
        UNetSegmenter(untrained, bfloat16=True)


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a CUDA device")
def test_a_device_that_is_not_there_is_named(untrained):
    with pytest.raises(UsageError, match="torch finds no device 'cuda:0'"):
        UNetSegmenter(untrained, device="cuda:0")
