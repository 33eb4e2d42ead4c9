"""The exported network says what torch says, at any size."""

import gzip
import sys

import numpy as np
import pytest
import torch

from canopy_skel.errors import UsageError
from canopy_skel.segmenters.unet.grouping import Grouping
from canopy_skel.segmenters.unet.network import UNet, normalised
from canopy_skel.segmenters.unet.onnx_export import INPUT, OUTPUT, export_onnx
from canopy_skel.segmenters.unet.weights import Model, untaught_scorer


@pytest.fixture
def onnxruntime():
    pytest.importorskip("onnx", reason="needs the extra `onnx`")
    return pytest.importorskip("onnxruntime", reason="needs the extra `onnx`")


@pytest.fixture
def model():
    torch.manual_seed(3)
    channels = (8, 12, 16, 16, 24)
    network = UNet(channels)
    for module in network.modules():
        if isinstance(module, torch.nn.BatchNorm2d):
            module.running_mean.normal_(0, 0.2)
            module.running_var.uniform_(0.5, 2)
    return Model(
        network=network.eval(),
        channels=channels,
        zoom=1.0,
        grouping=Grouping(),
        scorer=untaught_scorer(channels),
        least_score=0.5,
    )


@pytest.mark.filterwarnings("default")
def test_onnxruntime_gives_the_maps_of_torch(onnxruntime, model, tmp_path):
    export_onnx(model, tmp_path / "unet.onnx")
    session = onnxruntime.InferenceSession(tmp_path / "unet.onnx")
    rng = np.random.default_rng(0)
    for count, height, width in ((1, 64, 96), (2, 160, 32)):
        pictures = rng.integers(0, 256, (count, height, width, 3), dtype=np.uint8)
        with torch.inference_mode():
            expected = model.network(normalised(pictures)).numpy()
        given = pictures.transpose(0, 3, 1, 2).astype(np.float32)
        (maps,) = session.run([OUTPUT], {INPUT: given})
        assert maps.shape == (count, 8, height // 2, width // 2)
        np.testing.assert_allclose(maps, expected, atol=2e-4)


@pytest.mark.usefixtures("onnxruntime")
def test_a_name_in_gz_packs_it(model, tmp_path):
    export_onnx(model, tmp_path / "unet.onnx")
    export_onnx(model, tmp_path / "unet.onnx.gz")
    packed = (tmp_path / "unet.onnx.gz").read_bytes()
    assert gzip.decompress(packed) == (tmp_path / "unet.onnx").read_bytes()


@pytest.mark.usefixtures("onnxruntime")
def test_a_folder_that_is_not_there_is_named(model, tmp_path):
    with pytest.raises(UsageError, match=r"none/unet\.onnx: cannot be written"):
        export_onnx(model, tmp_path / "none" / "unet.onnx")


def test_without_onnx_the_extra_is_named(model, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "onnx", None)
    with pytest.raises(UsageError, match=r"needs the extra `onnx`: pip install 'canopy-skel\[onnx"):
        export_onnx(model, tmp_path / "unet.onnx")
